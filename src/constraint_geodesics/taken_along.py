"""Files of others that a planner's folder takes along, so that it works on another machine: URDFs
with their meshes, an SRDF, meshes of shapes.

They lie in its folder `files`, under names that tell their content, and the card names them there.
What is found among PyBullet's files, and not by its path, stays where it is.
"""

import copy
import hashlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from constraint_geodesics.params import RobotParams
from constraint_geodesics.robot.arm_file import content_digest
from constraint_geodesics.robot.description import find_mesh
from constraint_geodesics.scene.triangles import read_triangles
from constraint_geodesics.text_files import read_content
from constraint_geodesics.xml_files import read_xml

FILES = "files"
_WORDS = ("adjacent", "found")
"""What `may_touch` says where it names no file."""
_COLOUR = b"newmtl"
"""What begins each one in a file of colours."""


class MissingFileError(ValueError):
    """A folder lacks a file that its card names, or has another; the message names it."""


def taken_along(card: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, bytes]]:
    """A card with the names that its files have in the folder, and the content of each.

    Raises OSError for a file that can't be read, XmlFileError for a URDF that is none.
    """
    own, contents = copy.deepcopy(dict(card)), dict[str, bytes]()
    for entry, key in _named(own):
        file = Path(entry[key])
        if entry[key] not in _WORDS and file.is_file():
            entry[key] = (_urdf if key == "urdf" else _plain)(file, contents)
    return own, contents


def put_back(card: Mapping[str, Any], folder: Path) -> None:
    """Give a card, in place, the whole paths of the files that its folder has.

    Raises MissingFileError for one that is missing, lies elsewhere, or is not what was written.
    """
    known = card["sha256"]
    for name in known:
        if name.startswith(f"{FILES}/"):
            _require(folder, name, known[name])
    for entry, key in _named(card):
        if entry[key].startswith(f"{FILES}/"):
            if entry[key] not in known:
                raise MissingFileError(f"{folder / entry[key]}: its checksum is missing")
            entry[key] = str((folder / entry[key]).absolute())


def as_taken(robot: RobotParams) -> RobotParams:
    """With the names that its files have in any folder: equal for the same robot."""
    names = {}
    for key in ("urdf", "may_touch"):
        parts = Path(getattr(robot, key)).parts
        if FILES in parts:
            last = len(parts) - 1 - parts[::-1].index(FILES)
            names[key] = "/".join(parts[last:])
    return robot.model_copy(update=names)


def _named(card: Mapping[str, Any]) -> Iterator[tuple[dict[str, Any], str]]:
    """Entries that name a file, each with its key."""
    shapes = _inner(_inner(card, "workcell"), "shapes")
    places = [(_inner(card, "robot"), ("urdf", "may_touch"))]
    places += [(_inner(shapes, name), ("urdf", "file")) for name in shapes]
    for entry, keys in places:
        yield from ((entry, key) for key in keys if isinstance(entry.get(key), str))


def _inner(record: Mapping[str, Any], name: str) -> dict[str, Any]:
    """An entry that has entries; nothing where it has none, which others refuse."""
    found = record.get(name)
    return found if isinstance(found, dict) else {}


def _urdf(file: Path, contents: dict[str, bytes]) -> str:
    tree = read_xml(file)
    for mesh in tree.iter("mesh"):
        found = find_mesh(mesh.get("filename", ""), file)
        if found is not None and _is_mesh(found):
            mesh.set("filename", _plain(found, contents).removeprefix(f"{FILES}/"))
    content = ElementTree.tostring(tree)
    digest = content_digest(content)
    name = f"{FILES}/{file.stem.removesuffix(f'-{digest}')}-{digest}.urdf"  # it may be one of ours
    contents[name] = content
    return name


def _is_mesh(file: Path) -> bool:
    """Whether a URDF's mesh is one that can be read: it may name any file of this machine, and what
    lies in the folder is handed on.
    """
    try:
        read_triangles(file, content_digest(read_content(file)))
    except (OSError, ValueError):
        return False
    return True


def _plain(file: Path, contents: dict[str, bytes]) -> str:
    """A file as it is, and the colours beside an OBJ."""
    content, colours = read_content(file), file.with_suffix(".mtl")
    folder = f"{FILES}/{content_digest(content)}"
    contents[f"{folder}/{file.name}"] = content
    if colours.is_file() and _COLOUR in (drawn := read_content(colours)):
        contents[f"{folder}/{colours.name}"] = drawn
    return f"{folder}/{file.name}"


def _require(folder: Path, name: str, wanted: Any) -> None:
    file = folder / name
    try:
        inside = file.resolve().is_relative_to((folder / FILES).resolve())
        content = read_content(file, piped=False) if inside else b""
    except OSError as error:
        raise MissingFileError(f"{file}: {error.strerror}") from None
    except ValueError:  # NUL
        raise MissingFileError(f"{folder}: {name!r} is no name of a file") from None
    if not inside:
        raise MissingFileError(f"{file}: lies outside of the planner's folder")
    if hashlib.sha256(content).hexdigest() != wanted:
        raise MissingFileError(f"{file}: altered since it was written (its checksum differs)")
