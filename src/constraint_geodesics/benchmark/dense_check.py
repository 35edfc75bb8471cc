"""A second judge of answered paths: PyBullet at configurations close to each other, which knows
nothing of the certifier's proof.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from constraint_geodesics.benchmark.queries import Query
from constraint_geodesics.benchmark.runner import Answer, Look
from constraint_geodesics.learning.lift import densify
from constraint_geodesics.scene.scene import Scene

DENSE_RAD = 0.005
"""Distance of the configurations of an answered path at which PyBullet is asked."""


@contextmanager
def watched(query: Query, scene: Scene) -> Iterator[Look]:
    """What PyBullet says of the ends, and of every path, in a world of its own."""
    with scene.world() as world:
        ends = []
        for name, q in (("start", query.start), ("goal", query.goal)):
            if scene.robot.limit_distance(q) < 0.0:
                ends.append(f"{name} is out of limits")
            elif not world.is_free(q):
                ends.append(f"{name} touches")

        def look(answer: Answer) -> Mapping[str, Any]:
            found = {"ends": ", ".join(ends), "touches": False, "looked_at": 0}
            if len(answer.joints) < 2 or not np.isfinite(answer.joints).all():
                return found
            dense = densify(answer.joints, DENSE_RAD)
            touches = world.first_collision(dense) is not None
            return found | {"touches": touches, "looked_at": len(dense)}

        yield look
