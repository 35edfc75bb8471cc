"""The kinds of shapes that params.yaml may name."""

from typing import Annotated

from pydantic import Field

from constraint_geodesics.scene.body import Body
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.capsule import Capsule
from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.point_cloud import PointCloud
from constraint_geodesics.scene.sphere import Sphere

AnyShape = Annotated[
    Box | Sphere | Capsule | Cylinder | Mesh | PointCloud | Body, Field(discriminator="kind")
]
