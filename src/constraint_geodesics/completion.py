"""What the shell proposes when Tab is pressed, read from small files: nothing heavy is loaded."""

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from constraint_geodesics.plugs import METHODS
from constraint_geodesics.recording.folders import FOLDERS

PIPELINE = Path("data") / "planner" / "planner.json"
PACKAGED = Path(__file__).parent / "pretrained" / "planner.json"


class Proposal(NamedTuple):
    """As click's CompletionItem, which typer has in a copy of its own or from click itself."""

    value: str
    help: str
    type: str = "plain"


def planned_constraints(context: Any, parameter: Any, incomplete: str) -> list[Any]:
    """Constraints that the planner knows: of --planner, the pipeline, or the package; or those of
    any arm.
    """
    del parameter
    if context.params.get("urdf"):
        return _items({"free": "", "level": ""}, incomplete)
    named = Path(str(context.params.get("planner") or "")) / "planner.json"
    card = next((file for file in (named, PIPELINE, PACKAGED) if file.is_file()), None)
    return _items(_named(_json(card), "constraints", "description"), incomplete)


def listed_constraints(context: Any, parameter: Any, incomplete: str) -> list[Any]:
    """Constraints of params.yaml, those that training has not seen too."""
    del context, parameter
    seen, unseen = (_named(_params(), own, "description") for own in ("constraints", "unseen"))
    return _items(seen | unseen, incomplete)


def benchmarked_planners(context: Any, parameter: Any, incomplete: str) -> list[Any]:
    """Planners of the benchmark."""
    del context, parameter
    return _items(_named(_by_name(_params()).get("benchmark"), "planners", "kind"), incomplete)


def methods(context: Any, parameter: Any, incomplete: str) -> list[Any]:
    """Methods of the planner."""
    del context, parameter
    return _items(dict.fromkeys(METHODS, ""), incomplete)


def recordings(context: Any, parameter: Any, incomplete: str) -> list[Any]:
    """Recordings of this checkout, and those in the folder that the word names."""
    del context, parameter
    made = [str(file) for folder in FOLDERS for file in sorted(Path(folder).rglob("*.rrd"))]
    folder = incomplete[: incomplete.rfind("/") + 1]
    near = [folder + file.name for file in sorted(Path(folder or ".").glob("*.rrd"))]
    return _items(dict.fromkeys([*made, *near], ""), incomplete)


def _named(document: Any, entries: str, about: str) -> dict[str, str]:
    """The names below an entry, and what each says under `about`: as far as there are some."""
    own = _by_name(_by_name(document).get(entries))
    return {str(name): str(_by_name(entry).get(about, "")) for name, entry in own.items()}


def _by_name(value: Any) -> Mapping[Any, Any]:
    """What a file has under a name, where that holds entries by name; it may be half typed."""
    return value if isinstance(value, Mapping) else {}


def _items(names: Mapping[str, str], incomplete: str) -> list[Proposal]:
    return [
        Proposal(_typed(name), about)
        for name, about in names.items()
        if name.startswith(incomplete)
    ]


def _typed(name: str) -> str:
    """As bash takes it, which quotes no proposal; other shells quote it themselves."""
    if os.environ.get("_GEODESICS_COMPLETE") != "complete_bash" or _inside_quotes():
        return name
    return re.sub(r"([^\w@%+=:,./-])", r"\\\1", name)


def _inside_quotes() -> bool:
    return os.environ.get("COMP_WORDS", "").split("\n")[-1].startswith(("'", '"'))


def _json(file: Path | None) -> Any:
    try:
        return json.loads(file.read_text()) if file else {}
    except (OSError, ValueError):
        return {}


def _params() -> Any:
    """params.yaml as it stands: one with a mistake in it still has names to propose."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        return YAML(typ="safe", pure=True).load(Path("params.yaml")) or {}
    except (OSError, YAMLError):
        return {}
