"""The packaged planner's workcell, chart and judge, for the tests of its peers."""

from collections.abc import Iterator

import pytest
from tests.planner_fixtures import packaged_chart, packaged_planner, untrained_diffusion

from constraint_geodesics.certification.certifier import Certifier, Limits
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.path_diffusion import PathDiffusion
from constraint_geodesics.scene.world import World


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    with packaged_planner().scene.world() as loaded:
        yield loaded


@pytest.fixture(scope="session")
def chart() -> LearnedManifold:
    return packaged_chart()


@pytest.fixture(scope="module")
def certifier() -> Iterator[Certifier]:
    with Certifier(packaged_planner().scene.now, Limits()) as loaded:
        yield loaded


@pytest.fixture(scope="session")
def blank_diffusion() -> PathDiffusion:
    return untrained_diffusion()
