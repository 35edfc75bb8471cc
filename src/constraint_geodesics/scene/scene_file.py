"""Scenes in files: shapes around the robot, shapes that it carries, and what may touch.

format: 1
shapes:
  crate: {kind: box, centre_m: [0.4, 0.2, 0.1], size_m: [0.2, 0.2, 0.2]}
attached:
  cup: {link: link6, kind: sphere, centre_m: [0, 0, 0.07], radius_m: 0.06, touching: [link5]}
allowed:
- [cup, crate]
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from constraint_geodesics.errors import ParamsError
from constraint_geodesics.fields import Name
from constraint_geodesics.formats import NUMBER, SCENE, FormatError
from constraint_geodesics.params import one_line, read_yaml
from constraint_geodesics.scene.attached import Attached
from constraint_geodesics.scene.body import Body
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.planning_scene import PlanningScene
from constraint_geodesics.scene.scene import Scene, SceneError
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.scene.shapes import AnyShape


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Held(_Record):
    """An attached shape, its own fields beside its link's name."""

    link: str
    touching: tuple[str, ...] = ()
    shape: AnyShape


class SceneFile(_Record):
    """What a file says, shapes by name."""

    shapes: dict[Name, AnyShape] = {}
    attached: dict[Name, _Held] = {}
    allowed: tuple[tuple[str, str], ...] = ()

    @model_validator(mode="before")
    @classmethod
    def _named(cls, raw: Any) -> Any:
        """Each shape with its name, and an attached one apart from where it is attached."""
        if not isinstance(raw, dict):
            raise ValueError("must have the entries shapes, attached and allowed, or some of them")
        found = dict(raw)
        for group, given in (("shapes", _shape), ("attached", _held)):
            entries = raw.get(group) or {}
            if not isinstance(entries, dict):
                raise ValueError(f"{group} must be shapes by name")
            found[group] = {name: given(name, own) for name, own in entries.items()}
        found["allowed"] = raw.get("allowed") or ()
        return found

    def into(self, scene: PlanningScene) -> None:
        """Add all of it to a planner's scene, or nothing.  What stands there is attached where it
        is that shape; another one of its name is refused, which would take its place unseen.
        """
        scene.change(self._added)

    def _added(self, now: Scene) -> Scene:
        now = now.adding(*self.shapes.values())
        around = {shape.name: shape for shape in now.workcell}
        for name, held in self.attached.items():
            if name in around and not around[name].is_like(held.shape):
                line = "another shape of that name stands in the scene: give one another name"
                raise SceneError(f"attached.{name}: {line}")
            now = now.attaching(Attached(held.shape, held.link, held.touching))
        for first, second in self.allowed:
            now = now.allowing(first, second)
        return now


def read_scene(file: Path) -> SceneFile:
    """A scene's file; meshes and URDFs that it names are looked for beside it first.  Raises
    SceneError, one line, for one that can't be read, naming the entry.
    """
    return _read(file, SceneFile.model_validate)


def read_attached(file: Path) -> SceneFile:
    """A file of attached shapes alone, by name."""
    return _read(file, lambda raw: SceneFile.model_validate({"attached": raw}))


def _read(file: Path, checked: Callable[[Any], SceneFile]) -> SceneFile:
    try:
        raw = read_yaml(file)
        if not isinstance(raw, dict):
            raise SceneError(f"{file}: no scene: must be entries by name")
        if not isinstance(raw.get(NUMBER), dict):  # else a shape of that name
            raw = SCENE.updated(raw)
        return _beside(file, checked(raw))
    except ParamsError as error:
        raise SceneError(str(error)) from None
    except FormatError as error:
        raise SceneError(f"{file}: {error}") from None
    except ValidationError as error:
        raise SceneError(f"{file}: {one_line(error)}") from None


def _beside(file: Path, found: SceneFile) -> SceneFile:
    """With meshes and URDFs that lie beside the file."""

    def placed(shape: Shape) -> Shape:
        if isinstance(shape, Mesh) and (file.parent / shape.file).is_file():
            return replace(shape, file=file.parent / shape.file)
        if isinstance(shape, Body) and (file.parent / shape.urdf).is_file():
            return replace(shape, urdf=file.parent / shape.urdf)
        return shape

    shapes = {name: placed(shape) for name, shape in found.shapes.items()}
    attached = {
        name: held.model_copy(update={"shape": placed(held.shape)})
        for name, held in found.attached.items()
    }
    return found.model_copy(update={"shapes": shapes, "attached": attached})


def _shape(name: str, given: Any) -> Any:
    return given | {"name": name} if isinstance(given, dict) else given


def _held(name: str, given: Any) -> Any:
    if not isinstance(given, dict):
        return given
    own = {key: value for key, value in given.items() if key in ("link", "touching")}
    shape = {key: value for key, value in given.items() if key not in own}
    return own | {"shape": shape | {"name": name}}
