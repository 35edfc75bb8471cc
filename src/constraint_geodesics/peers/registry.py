"""The baselines by their kinds: found among the files here, loaded when one is asked for."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from pathlib import Path

from pydantic import ValidationError

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.palette import FAMILIES
from constraint_geodesics.params import BaselineParams, Params, one_line
from constraint_geodesics.peers.baseline import BaselineError, BaselineSettings, Context
from constraint_geodesics.peers.making import made_together
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.problem import PathPlanner
from constraint_geodesics.scene.scene import Scene

MARK = "\nBASELINE = "
"""How a file here says that it holds a kind of baseline."""


@lru_cache(maxsize=1)
def kinds() -> tuple[str, ...]:
    """What `kind` may be in params.yaml: names of the files that hold one, none of them loaded."""
    files = Path(__file__).parent.glob("*.py")
    return tuple(
        sorted(file.stem for file in files if file != Path(__file__) and MARK in file.read_text())
    )


def kind_of(kind: str) -> type[BaselineSettings]:
    """What is known of a kind.  Raises BaselineError if there is none of that name."""
    if kind not in kinds():
        raise BaselineError(f"no kind {kind!r}: must be one of {', '.join(kinds())}")
    found: type[BaselineSettings] = import_module(f"{__package__}.{kind}").BASELINE
    return found


def settings_of(name: str, entry: BaselineParams) -> BaselineSettings:
    """The settings of a line of `benchmark.planners`, checked.

    Raises BaselineError, one line: the entry, its value and what is allowed.
    """
    where = f"benchmark.planners.{name}"
    try:
        given = json.dumps(entry.settings)
        return kind_of(entry.kind).model_validate_json(given, strict=True)
    except BaselineError as error:
        raise BaselineError(f"{where}: {error}") from None
    except ValidationError as error:
        raise BaselineError(f"{where}.{one_line(error)}") from None


def all_settings(params: Params) -> dict[str, BaselineSettings]:
    """The settings of every line of `benchmark.planners`; raises BaselineError as `settings_of`."""
    return {name: settings_of(name, entry) for name, entry in params.benchmark.planners.items()}


def colours(settings: Mapping[str, BaselineSettings]) -> dict[str, str]:
    """The colour of each baseline: that of its family."""
    return {name: FAMILIES[own.family].colour for name, own in settings.items()}


def after(name: str, settings: Mapping[str, BaselineSettings]) -> str:
    """The baseline whose path this one shortens: the same but for the band; "" if none."""
    own = settings[name]
    if not own.band or own.restarts_s is not None:
        return ""
    return next((other for other, theirs in settings.items() if theirs == own.bare), "")


@dataclass(frozen=True)
class BaselineBuilder:
    """Makes the benchmark's planners from one run's networks, graphs and parameters; picklable."""

    params: Params
    root: Path

    @contextmanager
    def __call__(
        self, names: Sequence[str], scene: Scene, constraint: str, manifold: ConstraintManifold
    ) -> Iterator[tuple[Mapping[str, PathPlanner], Mapping[str, float]]]:
        """The planners of these names for one scene and constraint, and the seconds that making
        each one took; what several share is counted for the first of them.

        Raises BaselineError if a name, kind or setting does not exist.
        """
        known = self.params.benchmark.planners
        for name in names:
            if name not in known:
                raise BaselineError(
                    f"benchmark.planners has no {name!r}: must be one of {', '.join(known)}"
                )
        settings = {name: settings_of(name, known[name]) for name in names}
        context = Context(scene, constraint, manifold, self.params, Layout(self.root), {})
        yield made_together(settings, context)
