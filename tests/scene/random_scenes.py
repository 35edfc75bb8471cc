"""Random changes of a planner's scene, of every kind and with shapes of every kind, and changes
that fail in the middle.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from tests.scene.mesh_files import Brick, write_bricks

from constraint_geodesics.constraints.constraint import Constraint
from constraint_geodesics.planner import Planner
from constraint_geodesics.robot.kinematics import RobotError
from constraint_geodesics.scene.attached import Attached
from constraint_geodesics.scene.body import Body
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.capsule import Capsule
from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.point_cloud import PointCloud
from constraint_geodesics.scene.scene import Scene, SceneError
from constraint_geodesics.scene.shape import Placement, Shape
from constraint_geodesics.scene.sphere import Sphere

FREE = Constraint((0,) * 6)
BRICKS = {
    "brick": (Brick((0.0, 0.0, 0.0), (1.0, 0.7, 0.5)),),
    "angle": (
        Brick((0.0, 0.0, -0.5), (1.0, 0.5, 0.25)),
        Brick((-0.75, 0.0, 0.25), (0.25, 0.5, 0.5)),
    ),
    "cup": (
        Brick((0.0, 0.0, -0.8), (0.6, 0.6, 0.2)),
        *(Brick((0.5 * x, 0.0, 0.1), (0.1, 0.6, 0.7)) for x in (-1, 1)),
        *(Brick((0.0, 0.5 * y, 0.1), (0.4, 0.1, 0.7)) for y in (-1, 1)),
    ),
    "gate": tuple(Brick((x, 0.0, 0.0), (0.3, 0.3, 0.8)) for x in (-1.0, 1.0)),
}
"""Meshes of size 1, convex and not."""
Kind = TypeVar("Kind", bound=Shape)
UPRIGHT = np.pi * np.array([-0.5, 0.0, 0.5, 1.0])
LOADS = ("load0", "load1")
NAMES = [f"shape{k}" for k in range(8)]


class Late(Sphere):
    """A shape that has pieces, and that PyBullet refuses when all else has followed."""

    def add_to(self, bullet: Any) -> int:
        raise RobotError(f"{self.name!r}: not now")


class RandomScene:
    """Changes a planner's scene; files of meshes are written to a folder, some of them again.

    bricks: what each mesh that is there consisted of when it was read.  log: what was done.
    """

    def __init__(self, planner: Planner, seed: int, folder: Path) -> None:
        self.planner, self.rng, self._folder = planner, np.random.default_rng(seed), folder
        self.bricks, self.log = dict[str, tuple[Brick, ...]](), list[str]()
        self._written = dict[Path, tuple[Brick, ...]]()
        self.links = list(planner.scene.links)

    @property
    def now(self) -> Scene:
        """The scene as a value."""
        return self.planner.scene.now

    def change(self) -> None:
        """One change at random."""
        kinds = [self._add, self._add, self._remove, self._move, self._attach, self._attach]
        kinds += [self._take, self._let_go, self._turn, self._allow, self._become]
        kinds += 2 * [self._rewrite]
        kind = kinds[self.rng.integers(len(kinds))]
        self.log.append(kind.__name__)
        kind()

    def fail(self) -> None:
        """A change that can't be made, at random; nothing has changed."""
        q, own = self.planner.robot.sample(8, self.rng), self.planner._certifier
        assert own._world is not None
        before, free, judged = self.now, own.collisions.free(q), own._world.free(q)
        near = [own.collisions.clearance(row) for row in q]
        search = self.planner._preparation._clearance
        apart = search.clearance(self.planner.robot, q)
        wrong = self._wrong(q)
        number = int(self.rng.integers(len(wrong)))
        self.log.append(f"fail {number}")
        with pytest.raises((SceneError, RobotError)):
            wrong[number]()
        assert self.now is before
        assert own.scene is before
        np.testing.assert_array_equal(own.collisions.free(q), free)
        np.testing.assert_array_equal(own._world.free(q), judged)
        np.testing.assert_array_equal([own.collisions.clearance(row) for row in q], near)
        search = self.planner._preparation._clearance
        np.testing.assert_array_equal(search.clearance(self.planner.robot, q), apart)

    def take_away(self) -> None:
        """A shape, what is carried first; the loads stay."""
        held = [one.shape for one in self.now.attached if one.name not in LOADS]
        if shape := self._one(held):
            self.planner.scene.detach(shape.name)
        else:
            shape = self._one(self._around())
            assert shape is not None, "nothing is free though nothing is there"
            self.planner.scene.remove(shape.name)

    def carry(self) -> None:
        """A long box and a bar, each at its own link, that keep off the links beside it and meet
        what stands around.
        """
        rng = self.rng
        turn = tuple(rng.uniform(-0.3, 0.3, 3).tolist())
        box = Box(LOADS[0], (0.0, 0.0, 0.2), (0.08, 0.12, 0.25), rpy_rad=turn)
        bar = Capsule(LOADS[1], (0.0, 0.0, 0.0), (0.0, 0.2, 0.1), 0.03)
        middle = len(self.links) // 2
        self.planner.scene.attach(box, self.links[-1], self.links[-6:])
        self.planner.scene.attach(bar, self.links[middle], self.links[middle - 2 :])

    def read_anew(self) -> None:
        """A mesh whose file is written again before it moves."""
        file = self._write(self._folder / "again.obj")
        mesh = Mesh("again", file, self._place(False), scale=0.1)
        self.planner.scene.add(self._read(mesh))
        self._write(file)
        self.planner.scene.move(self._read(mesh).name, self._place(False))

    def shape(self, name: str, held: bool = False) -> Shape:
        """One of any kind, size and place; its bricks are known from here on."""
        rng, at = self.rng, self._place(held)
        size = float(rng.uniform(0.015, 0.05) if held else rng.uniform(0.03, 0.15))
        exempt = (self._link(),) if rng.random() < 0.1 else ()
        kind = rng.choice(["box", "sphere", "capsule", "cylinder", "mesh", "mesh", "cloud"])
        if kind == "box":
            x, y, z = (size * rng.uniform(0.5, 2.0, 3)).tolist()
            return Box(name, at.position_m, (x, y, z), exempt, rpy_rad=at.rpy_rad)
        if kind == "sphere":
            return Sphere(name, at.position_m, size, exempt)
        if kind == "capsule":
            half = rng.normal(size=3) * size * (rng.random() < 0.9)
            ends = [tuple((at.position_m + sign * half).tolist()) for sign in (-1.0, 1.0)]
            return Capsule(name, *ends, radius_m=0.5 * size, exempt_links=exempt)
        if kind == "cylinder":
            return Cylinder(name, at, 2.0 * size, 0.5 * size, exempt)
        if kind == "cloud":
            points = rng.uniform(-size, size, (rng.integers(1, 12), 3))
            return PointCloud(name, points, 0.3 * size, at, exempt)
        ending = rng.choice([".obj", ".stl"])
        file = self._write(self._folder / f"{name}{rng.integers(2)}{ending}")
        return self._read(Mesh(name, file, at, exempt, scale=size))

    def _write(self, file: Path) -> Path:
        own, size = BRICKS[str(self.rng.choice(list(BRICKS)))], float(self.rng.uniform(0.6, 1.2))
        scaled = [[np.multiply(size, side).tolist() for side in brick] for brick in own]
        # an STL file has single precision
        digits = [np.float32(brick).astype(float).tolist() for brick in scaled]
        self._written[file] = tuple(Brick(tuple(c), tuple(h)) for c, h in digits)
        return write_bricks(file, self._written[file])

    def _read(self, shape: Kind) -> Kind:
        """It, whose file is about to be read."""
        if isinstance(shape, Mesh):
            self.bricks[shape.name] = self._written[Path(shape.file)]
        return shape

    def _place(self, held: bool) -> Placement:
        rng = self.rng
        turn = rng.choice(UPRIGHT, 3) if rng.random() < 0.3 else rng.uniform(-np.pi, np.pi, 3)
        if held:
            at = rng.uniform([-0.06, -0.06, 0.0], [0.06, 0.06, 0.15])
        else:
            at = rng.normal(size=3)
            at *= rng.uniform(0.35, 0.9) / np.linalg.norm(at)
        return Placement(tuple(at.tolist()), tuple(turn.tolist()))

    def _link(self) -> str:
        some = self.links[-4:] if self.rng.random() < 0.7 else self.links
        return str(self.rng.choice(some))

    def _touching(self) -> list[str]:
        if self.rng.random() < 0.8:
            return self.links[-6:]
        return [str(own) for own in self.rng.choice([*self.links, *self.now.names], 2)]

    def _around(self) -> list[Shape]:
        return [shape for shape in self.now.workcell if shape.name != "table"]

    def _one(self, shapes: Sequence[Shape]) -> Shape | None:
        return shapes[self.rng.integers(len(shapes))] if shapes else None

    def _held(self) -> Shape | None:
        return self._one([one.shape for one in self.now.attached])

    def _new(self) -> list[str]:
        free = [name for name in NAMES if name not in self.now.names]
        return free[: self.rng.integers(1, 3)] if len(free) > 1 else []

    def _add(self) -> None:
        self.planner.scene.add(*[self.shape(name) for name in self._new()])

    def _remove(self) -> None:
        if shape := self._one(self._around()):
            self.planner.scene.remove(shape.name)

    def _move(self) -> None:
        if shape := self._one(self._around()):
            self.planner.scene.move(self._read(shape).name, self._place(False))

    def _attach(self) -> None:
        if names := self._new():
            touching = [other for other in self._touching() if other != names[0]]
            self.planner.scene.attach(self.shape(names[0], held=True), self._link(), touching)

    def _take(self) -> None:
        """What stands around the arm, or another shape of that name."""
        if shape := self._one(self._around()):
            other = self.rng.random() < 0.3
            own = self.shape(shape.name, True) if other else shape.placed(self._place(True))
            touching = [name for name in self._touching() if name != own.name]
            self.planner.scene.attach(self._read(own), self._link(), touching)

    def _let_go(self) -> None:
        if shape := self._held():
            at = self.planner.robot.sample(1, self.rng)[0] if self.rng.random() < 0.5 else None
            self.planner.scene.detach((shape if at is None else self._read(shape)).name, at)

    def _turn(self) -> None:
        if shape := self._held():
            self.planner.scene.move(self._read(shape).name, self._place(True))

    def _allow(self) -> None:
        if self.now.names:
            first = str(self.rng.choice(self.now.names))
            others = [name for name in (*self.now.names, *self.links) if name != first]
            self.planner.scene.allow(first, str(self.rng.choice(others)))

    def _rewrite(self) -> None:
        """A file, which is read where its shape moves and not before."""
        held = [one.shape for one in self.now.attached]
        meshes = [own for own in (*self._around(), *held) if isinstance(own, Mesh)]
        if (shape := self._one(meshes)) is not None:
            assert isinstance(shape, Mesh)
            self._write(Path(shape.file))
            self._add()
            self.planner.scene.move(self._read(shape).name, self._place(shape in held))

    def _become(self) -> None:
        """Several changes in one."""
        self.planner.scene.become(self._changed(self.now))

    def _changed(self, now: Scene) -> Scene:
        if shape := self._one(self._around()):
            now = now.removing(shape.name)
        if names := self._new():
            now = now.adding(self.shape(names[0]))
        if len(names) > 1:
            held = self.shape(names[1], held=True)
            now = now.attaching(Attached(held, self._link(), tuple(self.links[-5:])))
        return now

    def _wrong(self, q: np.ndarray) -> list[Callable[[], object]]:
        scene, now, link = self.planner.scene, self.now, self.links[-1]
        good, other, gone = self.shape("good"), self.shape("other"), self._folder / "gone"
        file = self._folder / "bad.obj"
        file.write_text("v 0 0 0\nf 1 2 3\n")
        bad = Mesh("bad", file)
        found: list[Callable[[], object]] = [
            *3
            * [lambda: scene.become(self._changed(now).adding(Late("late", (1.0, 0.0, 0.5), 0.1)))],
            lambda: self.planner.plan(q[0], q[1], FREE, scene=[good, Late("late", (1, 1, 1), 0.1)]),
            lambda: scene.add(good, bad),
            lambda: scene.add(good, Mesh("bad", gone.with_suffix(".stl"))),
            lambda: scene.add(good, Body("bad", gone.with_suffix(".urdf"))),
            lambda: scene.add(good, other, good),
            lambda: scene.add(good, replace(other, name=link)),  # type: ignore[type-var]
            lambda: scene.attach(good, "no_link"),
            lambda: scene.attach(good, link, ["nothing"]),
            lambda: scene.allow("nothing", link),
            lambda: scene.become(now.adding(good).attaching(Attached(bad, link))),
            lambda: self.planner.plan(q[0], q[1], FREE, scene=[good, bad]),
        ]
        if around := self._around():
            name = around[0].name
            found += [
                lambda: scene.add(good, replace(other, name=name)),  # type: ignore[type-var]
                lambda: scene.become(now.removing(name).adding(good, bad)),
                lambda: scene.attach(replace(bad, name=name), link),
            ]
        held = [one.shape for one in now.attached]
        if meshes := [one for one in (*around, *held) if isinstance(one, Mesh)]:
            found += 3 * [lambda: self._without_its_file(meshes[0], good)]
        return found

    def _without_its_file(self, mesh: Mesh, other: Shape) -> None:
        """Move a mesh whose file is away, or broken, for a while."""
        file = Path(mesh.file)
        data = file.read_bytes()
        file.unlink()
        if self.rng.random() < 0.5:
            file.write_bytes(b"none")
        try:
            moved = self.now.adding(other).moving(mesh.name, Placement((0.5, 0.5, 0.5)))
            self.planner.scene.become(moved)
        finally:
            file.write_bytes(data)
