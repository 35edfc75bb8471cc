"""What is known of a baseline, and what it is made from."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict

from constraint_geodesics.bundle import Bundle, read_bundle
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.errors import WrongUsageError
from constraint_geodesics.fields import Positive
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.problem import PathPlanner
from constraint_geodesics.scene.scene import Scene

if TYPE_CHECKING:
    from constraint_geodesics.learning.learned_manifold import LearnedManifold

MANIFOLD = ("label_joints free", "train_manifold {searched}")
"""Stages that make the learned manifold."""
GRAPH = ("label_joints", "train_manifold {searched}", "extract_submanifold {searched}")
"""Stages that make it with the constraints' graphs on it."""


class BaselineError(WrongUsageError):
    """A planner of the benchmark can't be made; the message is one line with its name."""


@dataclass(frozen=True)
class Context:
    """What a baseline is made from: the scene, the constraint, and the run it takes parts from.

    shared: between those made together.
    """

    scene: Scene
    constraint: str
    manifold: ConstraintManifold
    params: Params
    layout: Layout
    shared: dict[str, Any]

    @property
    def searched(self) -> str:
        """Name of the manifold that the planner uses."""
        return self.params.geodesics.searched[0]

    @property
    def bundle(self) -> Bundle:
        """The planner's files."""
        return _bundle(self.layout.planner)

    def learned(self, manifold: str) -> "LearnedManifold":
        """One of the learned manifolds."""
        return _learned(self.layout.manifold(manifold))


class BaselineSettings(BaseModel):
    """Settings of one kind of baseline, by default the strongest, and what is known of the kind.

    band: its paths are shortened by an elastic band.  restarts_s: the shortest path of
    several seeds within that time [s].
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    family: ClassVar[str]
    """One of palette.FAMILIES: its colour."""
    random: ClassVar[bool] = True
    """Whether the seed plays a part; without, one seed is asked."""
    uses_clearance: ClassVar[bool] = True
    """Whether it is given the model of distances, whose making is then part of its preparation."""
    asks_in_python: ClassVar[bool] = False
    """Whether its search asks through Python for every state."""
    uses_bundle: ClassVar[bool] = False
    """Whether it is made from the planner's files, though it may use nothing trained of them."""
    made_by: ClassVar[tuple[str, ...]] = ()
    """First words of the stages that train or extract what any of its kind needs."""

    band: bool = False
    restarts_s: Positive | None = None

    def make(self, context: Context) -> PathPlanner:
        """The planner without band and restarts.  Raises ValueError if it can't be made."""
        raise NotImplementedError

    @property
    def trained(self) -> tuple[str, ...]:
        """As `made_by`, of what it needs with these settings."""
        return self.made_by

    @property
    def uses_roadmaps(self) -> bool:
        """Whether the planner's roadmaps are among what it uses of the planner's files."""
        return self.uses_bundle

    @property
    def ends_by_counting(self) -> bool:
        """Whether it gives the same path at any speed of the machine; a time limit that is reached
        only where nothing is found does not count.
        """
        return self.restarts_s is None

    @property
    def given_s(self) -> float:
        """Time that it is given for a query [s]; 0 where it is given none."""
        return self.restarts_s or 0.0

    @property
    def bare(self) -> Self:
        """The same without a band."""
        return self.model_copy(update={"band": False})

    @property
    def with_half_step(self) -> Self:
        """The same with half its step between two looks, which is asked after a path that was not
        certified; itself where it has no such step.
        """
        return self


@lru_cache(maxsize=4)
def _bundle(folder: Path) -> Bundle:
    return read_bundle(folder)


@lru_cache(maxsize=4)
def _learned(folder: Path) -> "LearnedManifold":
    from constraint_geodesics.learning.learned_manifold import LearnedManifold

    return LearnedManifold.load(folder)
