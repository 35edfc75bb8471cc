"""Which settings a sweep tries: a grid or a random search over entries of params.yaml.

The space is a small YAML file; `stages/sweep/space.yaml` is the project's own and says what each
entry means.
"""

import math
from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    model_validator,
)

from constraint_geodesics.errors import ParamsError
from constraint_geodesics.fields import Count, Finite, Seed
from constraint_geodesics.params import one_line, read_yaml

SEARCHED = ("policies.", "geodesics.degree", "sweep.steps")
"""Where the entries lie that a policy's training depends on."""
NOT_SEARCHED = ("policies.seeds", "policies.steps")
"""In whose place a sweep has its own."""
DIGITS = 3
"""Of a number drawn from a range."""
DRAWN_IN_VAIN = 1000
"""Draws without a new configuration after which a space is taken for exhausted."""

LETTERS = {"length_weight": "K_L", "reduction_weight": "K_Δ"}

Changes = dict[str, Any]
"""Entries of params.yaml, by their paths, and their values."""


class Range(BaseModel):
    """Numbers between two bounds, spread evenly or evenly in their logarithm."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    low: Finite
    high: Finite
    scale: Literal["linear", "log"] = "linear"

    @model_validator(mode="after")
    def _in_order(self) -> "Range":
        if not self.low < self.high:
            raise ValueError(f"high={self.high}: must be above low, {self.low}")
        if self.scale == "log" and self.low <= 0:
            raise ValueError(f"low={self.low}: must be above 0 where the scale is log")
        return self

    def drawn(self, rng: np.random.Generator) -> float:
        """A number of DIGITS digits."""
        if self.scale == "linear":
            value = rng.uniform(self.low, self.high)
        else:
            value = math.exp(rng.uniform(math.log(self.low), math.log(self.high)))
        return float(f"{value:.{DIGITS}g}")


Dimension = Annotated[
    Annotated[list[Any], Field(min_length=1), Tag("<values>")] | Annotated[Range, Tag("<range>")],
    Discriminator(lambda given: "<range>" if isinstance(given, dict | Range) else "<values>"),
]
"""Values, or a range of them."""


class SearchSpace(BaseModel):
    """A grid, or a random search, over entries of params.yaml.

    configurations, seed: of a random search.  space: an entry, or several with ", " between them
    that change together, and its values or its range.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    search: Literal["grid", "random"]
    configurations: Count = 24
    seed: Seed = 0
    space: Annotated[dict[str, Dimension], Field(min_length=1)]

    @model_validator(mode="after")
    def _consistent(self) -> "SearchSpace":
        for name, values in self.space.items():
            entries = name.split(", ")
            if isinstance(values, Range):
                if self.search == "grid":
                    raise ValueError(f"space.{name}: a grid needs a list of values")
            elif len(entries) > 1:
                for value in values:
                    if not isinstance(value, list) or len(value) != len(entries):
                        raise ValueError(f"space.{name}={value!r}: needs {len(entries)} values")
        for entry in ", ".join(self.space).split(", "):
            if not entry.startswith(SEARCHED):
                raise ValueError(f"space.{entry}: must begin with {' or '.join(SEARCHED)}")
            if entry in NOT_SEARCHED:
                raise ValueError(f"space.{entry}: a sweep has its own: sweep.seeds, sweep.steps")
        return self

    def changes(self) -> list[Changes]:
        """What each configuration changes in params.yaml, none twice."""
        if self.search == "grid":
            return [self._named(values) for values in product(*self.space.values())]
        found: dict[str, Changes] = {}
        in_vain = 0
        for values in self._draws():
            changed = self._named(values)
            in_vain = in_vain + 1 if repr(changed) in found else 0
            found[repr(changed)] = changed
            if len(found) == self.configurations or in_vain == DRAWN_IN_VAIN:
                break
        return list(found.values())

    def _draws(self) -> Iterator[tuple[Any, ...]]:
        rng = np.random.default_rng(self.seed)
        while True:
            yield tuple(
                own.drawn(rng) if isinstance(own, Range) else own[rng.integers(len(own))]
                for own in self.space.values()
            )

    def _named(self, values: tuple[Any, ...]) -> Changes:
        """One value of each dimension, by the entries that it changes."""
        changed: Changes = {}
        for name, value in zip(self.space, values, strict=True):
            entries = name.split(", ")
            changed |= dict(zip(entries, value if len(entries) > 1 else [value], strict=True))
        return changed


def read_space(file: Path) -> SearchSpace:
    """Read and check a search space.

    Raises ParamsError, one line: the file, the entry, its value and what is allowed.
    """
    try:
        return SearchSpace.model_validate(read_yaml(file))
    except ValidationError as error:
        raise ParamsError(f"{file}: {one_line(error)}") from None


def label_of(changes: Mapping[str, Any]) -> str:
    """Changes in a few characters: the last word of each entry, or its letter of eq. 15, and its
    value.
    """
    named = []
    for name, value in changes.items():
        word = name.rpartition(".")[2]
        shown = f"{value:g}" if isinstance(value, float) else str(value)
        named.append(f"{LETTERS.get(word, word)}={shown}")
    return " ".join(named) or "as in params.yaml"
