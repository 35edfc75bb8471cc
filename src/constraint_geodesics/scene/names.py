"""Names of shapes and links in a scene: what they may be, and what may be named."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from constraint_geodesics.scene.attached import Attached
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.values import shown


class SceneError(ValueError):
    """A change that a scene can't take; the message names the shape and what is wrong."""


def shapes_of(given: Any, name: str) -> tuple[Shape, ...]:
    """Shapes of a list.  Raises SceneError, with the name of the list, for what is none, and for
    two of one name.
    """
    if not isinstance(given, Iterable) or isinstance(given, str | Mapping):
        raise SceneError(f"{name} = {shown(given)}: must be a list of shapes")
    found = tuple(given)
    for shape in found:
        if not isinstance(shape, Shape):
            raise SceneError(f"{shown(shape)} is no shape: a scene takes Box, Sphere, …")
    _require_distinct([shape.name for shape in found])
    return found


def require_texts(*names: Any) -> None:
    """That names are texts.  Raises SceneError."""
    for name in names:
        if not isinstance(name, str):
            raise SceneError(f"{shown(name)} is no name of a link, nor of a shape")


def require_names(
    links: Collection[str],
    workcell: Sequence[Shape],
    attached: Sequence[Attached],
    allowed: Collection[tuple[str, str]],
) -> None:
    """That every shape has a name of its own, which no link of the robot has, that links which are
    named are the robot's, and that what may touch is there.  Raises SceneError.
    """
    shapes = (*workcell, *(one.shape for one in attached))
    given = [shape.name for shape in shapes]
    names = set(given)
    for name in given:
        if name in links:
            raise SceneError(f"{name!r} is a link of the robot: give the shape another name")
    _require_distinct(given)
    for link in (*(own for s in shapes for own in s.exempt_links), *(one.link for one in attached)):
        if link not in links:
            raise SceneError(f"no link is called {link!r}: {', '.join(links)}")
    touching = (other for one in attached for other in one.touching)
    for name in (*touching, *(end for pair in allowed for end in pair)):
        if name not in links and name not in names:
            raise SceneError(f"{name!r} is no link of the robot, nor a shape of the scene")


def _require_distinct(names: Sequence[str]) -> None:
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise SceneError(f"two shapes are called {twice!r}: give one another name")
