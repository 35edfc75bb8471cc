import numpy as np
import pytest

from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.world import World


def test_upright_is_free_and_bent_into_the_table_is_not(scene: Scene) -> None:
    upright, down = np.zeros(6), np.array([0.0, 1.9, -0.6, 0.0, 0.0, 0.0])
    with scene.world() as world:
        labels = world.label(np.stack([upright, down]))
    assert labels.position[1, 2] < 0
    assert labels.workcell_collision.tolist() == [False, True]


def test_the_table_is_what_collides(scene: Scene) -> None:
    down = np.array([0.0, 1.9, -0.6, 0.0, 0.0, 0.0])
    with World(scene.robot) as bare:
        assert not bare.label(down[None]).workcell_collision[0]


def test_without_exemption_the_base_touches_its_table(scene: Scene) -> None:
    table = Box("table", (0.0, 0.0, -0.05), (2.4, 2.4, 0.1))
    with World(scene.robot, [table]) as world:
        assert world.label(np.zeros((1, 6))).workcell_collision[0]


def test_self_collision_needs_no_workcell(scene: Scene) -> None:
    q = scene.robot.sample(300, np.random.default_rng(0))
    with World(scene.robot) as world:
        labels = world.label(q)
        assert 0.02 < labels.self_collision.mean() < 0.3
        assert not labels.workcell_collision.any()
        np.testing.assert_array_equal(world.free(q), ~labels.self_collision)


def test_an_exempt_link_must_exist(scene: Scene) -> None:
    with pytest.raises(ValueError, match="wrist"):
        World(scene.robot, [Box("table", (0, 0, -0.1), (1, 1, 0.1), ("wrist",))])


def test_what_is_said_of_a_configuration_hangs_on_none_before(scene: Scene) -> None:
    """On this line through a thin plate PyBullet lists a contact from before, 57 mm deep, where the
    tool is 0.2 mm beyond the plate.
    """
    middle, turned = (0.385313, -0.116618, 0.121411), (0.611937, -2.072554, -1.358975)
    plate = Box("plate", middle, (0.44629, 0.405245, 0.004), rpy_rad=turned)
    ends = (
        (0.066910804, 0.019165697, -0.612012413, -2.034068807, 1.574598240, 1.049143949),
        (0.147732309, -0.048778510, -0.482671400, -2.071216421, 1.491368400, 1.109770540),
    )
    line = np.linspace(*ends, 41)
    with World(scene.robot, [plate]) as world:
        along = world.free(line)
    alone = []
    for row in line:
        with World(scene.robot, [plate]) as fresh:
            alone.append(fresh.is_free(row))
    assert along.tolist() == alone
    assert not along.all()
    assert along[-1]
