"""What code a stage's results hang on: the modules that its script imports, theirs, and kinds.

DVC sees files, not imports, so the stage `digest_code` writes what this finds to one file a stage,
and the stages depend on those files.  A digest is one of the syntax tree: comments, docstrings and
the formatter change none.
"""

import ast
import hashlib
import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path

DRAWING = ("palette", "recording", "report")
"""Rooms that change no figure.  They count where a stage's own script imports one of them: such a
stage draws."""
FOUND_BY_NAME = {
    "certification/kept.py": ("certification/*.py",),
    "constraints/constraint.py": ("constraints/*.py",),
    "peers/planner.py": ("geodesics/learned_method.py",),
    "peers/registry.py": ("peers/*.py",),
    "scene/scene.py": ("scene/*.py",),
}
"""What a module reaches without an import statement: kinds that params.yaml names."""
NO_RESULT = ("__init__", "cli", "params", "pipeline", "tracking")
"""Rooms that change no result: parameters are dependencies by their values."""
REGISTERED = ("tracking/registry.py", "tracking/served_model.py")
"""Who registers the planner, and the code that goes with it: a result where a stage's own script
imports the first.
"""
DEFAULTS = ("planner.py", ("PlannerParams", "JudgeParams"))
"""The module whose results also hang on what params.py has for these where nobody says another."""


def code_of(script: Path, package: Path) -> dict[str, str]:
    """The files that a script's results hang on, relative to the package, with their digests.

    script: a Python file outside the package, whose own content is not among them.  package: the
    package's folder.  Imports within functions count as well, those for types alone do not.
    """
    first = list(_imported(script, package))
    draws = any(_room(file, package) in DRAWING for file in first)
    left_out = NO_RESULT if draws else NO_RESULT + DRAWING
    registers, found = set(first), set[Path]()
    left = first
    while left:
        file = left.pop()
        if file not in found and _room(file, package) not in left_out:
            found.add(file)
            left += _imported(file, package)
            for pattern in FOUND_BY_NAME.get(file.relative_to(package).as_posix(), ()):
                left += package.glob(pattern)
    found |= {page for file in found for page in file.parent.glob("templates/*")}
    if package / REGISTERED[0] in registers:
        found.add(package / REGISTERED[1])
    files = {file.relative_to(package).as_posix(): digest(file) for file in sorted(found)}
    if DEFAULTS[0] in files:
        files["defaults"] = _of_defaults()
    return files


def _of_defaults() -> str:
    from constraint_geodesics import params

    told = [getattr(params, name)().model_dump(mode="json") for name in DEFAULTS[1]]
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]


def code_lines(script: Path) -> str:
    """What `code_of` finds of a script, a line a file, so that two of them can be compared."""
    package = Path(__file__).parents[1]
    return "".join(f"{own}  {name}\n" for name, own in code_of(script, package).items())


@cache
def code_digest(*modules: str) -> str:
    """Of these modules of the package and of all that their results hang on, with the libraries
    that the checkout has locked.
    """
    package = Path(__file__).parents[1]
    lock, files = package.parents[1] / "requirements.lock", dict[str, str]()
    if lock.is_file():
        files[lock.name] = digest(lock)
    for module in modules:
        file = package.joinpath(*module.split(".")).with_suffix(".py")
        files |= {module: digest(file)} | code_of(file, package)
    return hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()


def data_digest(*folders: Path) -> str:
    """Of all files in some folders."""
    found = hashlib.sha256()
    for folder in folders:
        for file in sorted(path for path in folder.rglob("*") if path.is_file()):
            found.update(file.relative_to(folder).as_posix().encode() + file.read_bytes())
    return found.hexdigest()


@cache
def digest(file: Path) -> str:
    """Of a Python file's syntax without docstrings, or of any other file's bytes."""
    content = file.read_bytes()
    if file.suffix == ".py":
        tree = _tree(file)
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                node.body = [s for s in node.body if not _is_text(s)] or [ast.Pass()]
        content = ast.dump(tree, annotate_fields=False).encode()
    return hashlib.sha256(content).hexdigest()[:16]


def _is_text(statement: ast.stmt) -> bool:
    """A docstring, of a module, a class, a function or the name above it."""
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


@cache
def _tree(file: Path) -> ast.Module:
    return ast.parse(file.read_text("utf-8"))


@cache
def _imported(file: Path, package: Path) -> tuple[Path, ...]:
    if file.suffix != ".py":
        return ()
    found = (_module(package, parts) for parts in _names(_tree(file), package.name))
    return tuple(sorted({module for module in found if module is not None}))


def _names(node: ast.AST, package: str) -> Iterator[list[str]]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ImportFrom) and (child.module or "").split(".")[0] == package:
            parts = str(child.module).split(".")[1:]
            yield parts
            yield from ([*parts, name.name] for name in child.names)
        elif isinstance(child, ast.Import):
            names = [name.name.split(".") for name in child.names]
            yield from (parts[1:] for parts in names if parts[0] == package)
        elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test):
            yield from (parts for other in child.orelse for parts in _names(other, package))
        else:
            yield from _names(child, package)


def _module(package: Path, parts: list[str]) -> Path | None:
    places = (package.joinpath(*parts).with_suffix(".py"), package.joinpath(*parts, "__init__.py"))
    return next((place for place in places if place.is_file()), None) if parts else None


def _room(file: Path, package: Path) -> str:
    return file.relative_to(package).parts[0].removesuffix(".py")
