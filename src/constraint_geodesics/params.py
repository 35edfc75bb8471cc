"""params.yaml as typed, frozen records: every field is checked before a stage does any work."""

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    model_validator,
)

from constraint_geodesics.errors import ParamsError as ParamsError
from constraint_geodesics.fields import (
    Angles3,
    Bit,
    ChartDim,
    Count,
    Degree,
    Few,
    Finite,
    Name,
    NonNegative,
    Points,
    Positive,
    Rate,
    Rows,
    Seed,
    Seeds,
    Share,
    Vector3,
    Width,
)
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.scene.shapes import AnyShape
from constraint_geodesics.text_files import read_text
from constraint_geodesics.values import shown


class _Record(BaseModel):
    # a planner reads five of the records: the others' checks are built where they are needed
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class PoseParams(_Record):
    """A pose: of a tool in the base frame, of a tool's own frame in its link."""

    position_m: Vector3
    rpy_rad: Angles3


class RobotParams(_Record):
    """Which robot: a URDF, its tool link, and limits tighter than the URDF's.

    hold: values of joints that are not to move [rad or m]; those beside the chain rest.  tool: the
    tool's own frame in its link.  may_touch: pairs of links that may, "adjacent": a link and the
    one that it hangs on; "found": also those that nothing keeps apart, found by sampling; else the
    SRDF that names them.
    """

    urdf: str
    tool_link: str
    limits_rad: dict[str, tuple[Finite, Finite]] = {}
    hold: dict[str, Finite] = {}
    tool: PoseParams | None = None
    may_touch: str = "adjacent"


class WorkcellParams(_Record):
    """What surrounds the arm: shapes by name."""

    shapes: dict[Name, AnyShape] = {}

    def including(self, *shapes: Shape) -> "WorkcellParams":
        """The same workcell with more shapes, or others of the same names."""
        more = {shape.name: shape for shape in shapes}
        return self.model_copy(update={"shapes": {**self.shapes, **more}})

    @model_validator(mode="before")
    @classmethod
    def _named(cls, raw: Any) -> Any:
        """Each shape with its name."""
        shapes = raw.get("shapes") or {} if isinstance(raw, dict) else None
        if not isinstance(shapes, dict):
            return raw
        found = {
            name: shape | {"name": name} if isinstance(shape, dict) else shape
            for name, shape in shapes.items()
        }
        return _tuples(raw | {"shapes": found})


def _tuples(value: Any) -> Any:
    """With tuples for lists, as the strict mode of JSON has them."""
    if isinstance(value, dict):
        return {name: _tuples(own) for name, own in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


class CarriedParams(WorkcellParams):
    """What the arm carries in the tasks of some constraints: shapes by name, in the frame of its
    tool link, which may touch them.
    """

    constraints: tuple[Name, ...] = ()


_ADDRESS = re.compile(r"[a-z]+://[A-Za-z0-9_.:\[\]-]+:[0-9]{1,5}")


class ComputeParams(_Record):
    """Where parallel work runs."""

    backend: Literal["loky", "dask"]
    workers: Annotated[int, Field(ge=0, le=1024)]
    dask_address: str | None = None

    @model_validator(mode="after")
    def _address_given(self) -> "ComputeParams":
        if self.backend == "dask" and not self.dask_address:
            raise ValueError("dask_address is missing: backend 'dask' needs a scheduler's address")
        if self.dask_address and not _ADDRESS.fullmatch(self.dask_address):
            what = "must be an address with a port, as tcp://127.0.0.1:8786"
            raise ValueError(f"dask_address={self.dask_address!r}: {what}")
        return self


class LabelParams(_Record):
    """How many configurations are drawn and labelled, and how many start and goal pairs."""

    free_rows: Rows
    constrained_rows: Rows
    shard_rows: Count
    seed: Seed
    queries: Count
    query_seed: Seed


class PoseConstraintParams(_Record):
    """The constraint vector C of eq. 6 with tolerances and reference."""

    kind: Literal["pose"] = "pose"
    description: str
    axes: tuple[Bit, Bit, Bit, Bit, Bit, Bit]
    tolerance: tuple[NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative]
    reference: PoseParams | None

    @property
    def is_free(self) -> bool:
        """Whether no axis is held."""
        return not any(self.axes)

    @property
    def may_hold_positions(self) -> bool:
        """Whether something measured in metres is held."""
        return any(self.axes[:3])

    @property
    def keeps_upright(self) -> bool:
        """Whether both tilts are held."""
        return all(self.axes[3:5])

    @property
    def summary(self) -> str:
        """In a few characters."""
        return " ".join(map(str, self.axes))

    @model_validator(mode="after")
    def _consistent(self) -> "PoseConstraintParams":
        for i, (held, tolerance) in enumerate(zip(self.axes, self.tolerance, strict=True)):
            if tolerance and not held:
                raise ValueError(f"tolerance[{i}]={tolerance}: must be 0 where the axis is free")
            if i >= 3 and tolerance > math.pi:
                raise ValueError(f"tolerance[{i}]={tolerance}: must be at most π rad")
        if any(self.axes) and self.reference is None:
            raise ValueError(
                "reference=null: a pose is needed to sample configurations that hold an axis"
            )
        return self


class FunctionsConstraintParams(_Record):
    """A constraint given by two functions, which a factory makes: `module:function`, called with
    the robot and the arguments.
    """

    kind: Literal["functions"]
    description: str
    factory: Annotated[str, Field(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$")]
    arguments: dict[str, Any] = {}

    @property
    def is_free(self) -> bool:
        """It holds something."""
        return False

    @property
    def may_hold_positions(self) -> bool:
        """Only the factory knows."""
        return True

    @property
    def keeps_upright(self) -> bool:
        """Only the factory knows."""
        return False

    @property
    def summary(self) -> str:
        """In a few characters."""
        return self.factory


def _kind(entry: Any) -> str | None:
    kind = entry.get("kind", "pose") if isinstance(entry, dict) else getattr(entry, "kind", None)
    return None if kind is None else f"<{kind}>"


ConstraintParams = Annotated[
    Annotated[PoseConstraintParams, Tag("<pose>")]
    | Annotated[FunctionsConstraintParams, Tag("<functions>")],
    Discriminator(_kind),
]
"""An entry of `constraints`, by its `kind`, which is "pose" unless it is named."""


class ManifoldParams(_Record):
    """One learned manifold."""

    latent_dim: Count
    retract: bool
    hidden: Annotated[tuple[Width, ...], Field(min_length=1)]
    beta: NonNegative
    epochs: Count
    patience: Count
    batch_size: Count
    learning_rate: Rate
    variance_centres: Count
    variance_epochs: Count
    sigma_max_rad: Positive
    held_out: Share
    seed: Seed


class GplvmParams(_Record):
    """One Gaussian-process latent variable model.  noise: variance of the likelihood when training
    begins, in squares of joints scaled to [−1, 1].
    """

    latent_dim: Count
    hidden: Annotated[tuple[Width, ...], Field(min_length=1)]
    inducing: Count
    noise: Positive
    steps: Count
    batch_size: Count
    learning_rate: Rate
    centres: Annotated[int, Field(ge=2, le=10**6)]


class GanParams(_Record):
    """One generative adversarial network.  critic_steps: for one of the generator.  penalty: weight
    of the critic's slope.  average: memory of the generator's running average.
    """

    latent_dim: Count
    hidden: Annotated[tuple[Width, ...], Field(min_length=1)]
    steps: Count
    critic_steps: Count
    batch_size: Count
    learning_rate: Rate
    penalty: Positive
    average: Share
    encoder_steps: Count


class CompareManifoldsParams(_Record):
    """Learners of joint space on the same rows.  vae: which of `manifolds`.  samples: drawn from
    each; checked: of these for collisions and constraints.
    """

    vae: Name
    seeds: Seeds
    split_seed: Seed
    held_out: Count
    samples: Count
    checked: Count
    pairs: Count
    gplvm: GplvmParams
    gan: GanParams


class HoleParams(_Record):
    """What the data keeps away from; dimensions of charts learned from it, and pairs to join in
    them.
    """

    around: WorkcellParams
    dims: Annotated[tuple[ChartDim, ...], Field(min_length=1)]
    pairs: Count


class CompareChartsParams(_Record):
    """What a learned chart adds to the search.  vae: which of `manifolds` they are trained as, but
    for `dims`, seeds and epochs.  steps: of each policy.
    """

    vae: Name
    constraint: Name
    dims: Annotated[tuple[ChartDim, ...], Field(min_length=1)]
    seeds: Seeds
    epochs: Count
    steps: Count
    queries: Count
    query_seed: Seed
    hole: HoleParams


class LearnedDemonstrationsParams(_Record):
    """What is learned of demonstrations for comparison.  vae: the manifold whose networks it has;
    batches: in an epoch.
    """

    level_set_steps: Count
    residual_steps: Count
    vae: Name
    beta: NonNegative
    epochs: Count
    batches: Count
    policy_steps: Count


class DemonstrationsParams(_Record):
    """Constraints from demonstrations whose formula is hidden.  tasks: of
    studies/hidden_tasks.py.  pairs: queries of each cell, of which peers that are no planners are
    asked the first `peer_pairs`.
    """

    tasks: Annotated[tuple[str, ...], Field(min_length=1)]
    seeds: Seeds
    pairs: Count
    peer_pairs: Count
    learned: LearnedDemonstrationsParams


class SubmanifoldParams(_Record):
    """How a constraint's sub-manifold is drawn or sampled in the latent space."""

    grid: Annotated[int, Field(ge=10, le=10_000)]
    nodes: Points
    neighbours: Count
    edge_points: Few
    resolution_m: Positive
    resolution_rad: Positive


class RewardParams(_Record):
    """Eq. 15: r = K_L R_L + K_Δ R_Δ with R(x) = exp(−b exp(−c x)).

    Besides, `feasible_weight` for a feasible curve, and `set_weight` times what a curve adds to its
    set (`episodes.contributions`).
    """

    form: Literal["corrected", "printed"]
    b: Positive
    c: Positive
    length_weight: NonNegative
    reduction_weight: NonNegative
    feasible_weight: NonNegative = 0.0
    set_weight: NonNegative = 0.0

    @model_validator(mode="after")
    def _bounded(self) -> "RewardParams":
        total = self.length_weight + self.reduction_weight
        if not 0 < total <= 1 + 1e-9:
            raise ValueError(
                f"length_weight + reduction_weight = {total}: must lie in (0, 1], so that |r| ≤ 1"
            )
        return self


class PpoParams(_Record):
    """Proximal policy optimisation."""

    hidden: Annotated[tuple[Width, ...], Field(min_length=1)]
    learning_rate: Rate
    learning_rate_end: Rate
    gamma: Annotated[float, Field(gt=0, le=1)]
    gae_lambda: Annotated[float, Field(gt=0, le=1)]
    rollout_steps: Few
    batch_size: Annotated[int, Field(ge=2, le=10**9)]
    epochs: Count
    clip: Share
    entropy: NonNegative
    action_scale: Positive
    descent_scale: Positive = 0.5


class ObstacleParams(_Record):
    """Spheres that policies train with: `count` of each constraint, with radii [m] between two
    bounds, in a share of the episodes.
    """

    count: Count
    radii_m: tuple[Positive, Positive]
    share: Share

    @model_validator(mode="after")
    def _ordered(self) -> "ObstacleParams":
        if self.radii_m[0] > self.radii_m[1]:
            raise ValueError(f"radii_m={list(self.radii_m)}: the first must not be larger")
        return self


class PolicyParams(_Record):
    """Policies whose curves are retracted; what is not here is as in `geodesics`."""

    seeds: Seeds
    chart: Name
    steps: Count
    training_length_degree: Degree
    length_degree: Degree
    environments: Count
    episode_steps: Count
    heads: Count
    random_starts: Annotated[float, Field(ge=0, le=1)]
    rollouts: Count
    kept: Count
    rounds: Count
    obstacles: ObstacleParams
    reward: RewardParams
    ppo: PpoParams

    @model_validator(mode="after")
    def _fitting(self) -> "PolicyParams":
        _require_multiple(self.environments, self.heads)
        if not self.heads <= self.rollouts >= self.kept:
            raise ValueError(
                f"rollouts={self.rollouts}: must be at least heads={self.heads} and "
                f"kept={self.kept}"
            )
        return self


def _require_multiple(environments: int, heads: int) -> None:
    if environments % heads:
        raise ValueError(f"environments={environments}: must be a multiple of heads={heads}")


class GeodesicParams(_Record):
    """Policy search of geodesics.

    inclusion_weight: of leaving the sub-manifold, in a curve's cost, where it is not retracted.
    """

    seeds: Seeds
    searched: Annotated[tuple[Name, ...], Field(min_length=1)]
    illustrated: tuple[Name, ...]
    illustrated_constraints: Annotated[tuple[Name, ...], Field(min_length=1)]
    analytic_steps: Count
    analytic_episode_steps: Count
    analytic: tuple[Literal["plane", "sphere", "torus"], ...]
    ablated_segments: tuple[Few, ...]
    degree: Annotated[int, Field(ge=2, le=9)]
    length_degree: Degree
    steps: Count
    environments: Count
    episode_steps: Count
    inclusion_weight: NonNegative
    reward: RewardParams
    ppo: PpoParams
    rollouts: Count
    checkpoint_steps: Count
    heads: Count
    random_starts: Annotated[float, Field(ge=0, le=1)]
    kept: Count
    rounds: Count

    @model_validator(mode="after")
    def _fitting(self) -> "GeodesicParams":
        _require_multiple(self.environments, self.heads)
        return self

    def on_analytic(self) -> "GeodesicParams":
        """The settings on manifolds with a known answer."""
        own = {"steps": self.analytic_steps, "episode_steps": self.analytic_episode_steps}
        return self.model_copy(update=own)

    def of_training(self, *more: str) -> dict[str, Any]:
        """What one policy is trained with, and what else is named; the rest says what is trained
        besides.
        """
        own = {
            "seeds",
            "degree",
            "steps",
            "environments",
            "episode_steps",
            "heads",
            "random_starts",
            "reward",
            "ppo",
        }
        return self.model_dump(mode="json", include=own | set(more))


class GeometryParams(_Record):
    """Benchmark and ablation of the geometry core."""

    rounds: Count
    batch: Count
    checked: Count
    graph_points: Annotated[int, Field(ge=20, le=10**6)]
    pairs: Count


class PlannerParams(_Record):
    """The planner that users call.

    clearance_m: that bodies keep in the search.  clearance_share: of what they typically have, and
    no more is asked for: an arm whose links are close to each other could not move else; null for
    no such bound.  acceleration: of turning joints and of prismatic ones.
    """

    segments: Annotated[int, Field(ge=4, le=1000)] = 16
    iterations: Annotated[int, Field(ge=1, le=10_000)] = 30
    accuracy: Positive = 1e-5
    largest_step_rad: Positive = 0.5
    clearance_m: Annotated[float, Field(ge=0, le=1)] = 0.006
    clearance_share: Annotated[float, Field(gt=0, le=1)] | None = None
    acceleration_rad_s2: Positive = 10.0
    acceleration_m_s2: Positive = 1.0
    roadmap_nodes: Points = 2000
    roadmap_neighbours: Annotated[int, Field(ge=1, le=1000)] = 12
    seed: Seed = 0


class BaselineParams(BaseModel):
    """One planner of the benchmark: its kind (a file of peers/), and settings that differ from the
    kind's own, which the kind checks.  queries: of each scene; seeds: where chance plays a part;
    null: as many as the benchmark has.
    """

    model_config = ConfigDict(extra="allow", frozen=True)

    kind: Name
    queries: Count | None = None
    seeds: Count | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of the kind."""
        return self.model_extra or {}


class ComparisonParams(_Record):
    """Planners of the benchmark that answer the pipeline's queries, next to learned geodesics."""

    planners: Annotated[tuple[str, ...], Field(min_length=1)]
    seeds: Count


class BenchmarkParams(_Record):
    """All planners on the same queries."""

    queries: Count
    seeds: Count
    seed: Seed
    radius_m: Positive
    placed_by: Annotated[tuple[str, ...], Field(min_length=1)]
    batch: Count
    repeated: Count
    compared: ComparisonParams
    recorded: tuple[str, ...]
    drawn: tuple[str, ...]
    planners: Annotated[dict[str, BaselineParams], Field(min_length=1)]

    @property
    def compared_kinds(self) -> list[str]:
        """The kinds of the compared planners: under these they stand in the pipeline's tables."""
        return [self.planners[name].kind for name in self.compared.planners]

    @model_validator(mode="after")
    def _planners_exist(self) -> "BenchmarkParams":
        for entry, names in (
            ("compared.planners", self.compared.planners),
            ("placed_by", self.placed_by),
        ):
            for name in names:
                if name not in self.planners:
                    raise ValueError(f"{entry}={name!r}: must be one of {', '.join(self.planners)}")
        if len(set(self.compared_kinds)) < len(self.compared_kinds):
            raise ValueError(f"compared.planners={self.compared.planners}: one of each kind only")
        return self


class ProblemsParams(_Record):
    """Problems from a file, and queries with a held tilt in their scenes.  every: which of each
    scene's problems are asked, 1 all of them.  tilted: queries of each scene.  limit_s: of one
    query; held_limit_s: of one under a constraint.
    """

    file: str
    every: Count
    tilted: Annotated[int, Field(ge=0, le=10**6)]
    seed: Seed
    limit_s: Positive
    held_limit_s: Positive
    planners: Annotated[dict[str, BaselineParams], Field(min_length=1)]


class ClutterParams(_Record):
    """Queries of the pipeline's arm among random shapes: so many scenes of each kind, and queries
    of each kind and constraint.
    """

    scenes: Count
    queries: Count
    seed: Seed
    limit_s: Positive
    constraints: Annotated[tuple[Name, ...], Field(min_length=1)]


class PathDiffusionParams(_Record):
    """The diffusion model of paths, a baseline: how many of the planner's paths it learns from,
    how large it is, and how long it is trained.

    queries: planned for each constraint; modes: sines for each joint; width: of a layer.
    """

    queries: Count
    query_seed: Seed
    modes: Count
    width: Count
    blocks: Count
    steps: Count
    batch_size: Count
    learning_rate: Rate
    held_out: Share
    seed: Seed


class StudyParams(_Record):
    """On what the policies' proposals and executed paths are looked at."""

    constraint: Name
    queries: Count
    seed: Seed


class SweepParams(_Record):
    """How each configuration of `make sweep` is trained and judged: its seeds, environment steps of
    each in place of `policies.steps`, and queries that nothing else uses.
    """

    seeds: Seeds
    steps: Count
    queries: Count
    query_seed: Seed


class ExecutionParams(_Record):
    """Timed paths followed by simulated position control, with a cup that may spill."""

    queries: Count
    seed: Seed
    least_tilt_rad: Positive
    spheres: Count
    recorded: Count


class JudgeParams(_Record):
    """What makes a path valid."""

    end_tolerance_rad: Positive = 1e-6
    max_step_rad: Positive = 0.1
    violation_tolerance: Positive = 1e-4
    row_spacing_rad: Positive = 0.02
    spacing_rad: Positive = 0.02


class RecordingParams(_Record):
    """Which paths are recorded for replay."""

    queries: Count
    frames: Annotated[int, Field(ge=2, le=10_000)]


class TrackingParams(_Record):
    """MLflow."""

    experiment: Annotated[str, Field(pattern=r"\S")]


class Params(_Record):
    """The whole of params.yaml."""

    robot: RobotParams
    workcell: WorkcellParams
    compute: ComputeParams
    labels: LabelParams
    constraints: Annotated[dict[Name, ConstraintParams], Field(min_length=1)]
    carried: CarriedParams = CarriedParams()
    manifolds: Annotated[dict[Name, ManifoldParams], Field(min_length=1)]
    submanifold: SubmanifoldParams
    geodesics: GeodesicParams
    geometry: GeometryParams
    policies: PolicyParams
    planner: PlannerParams
    path_diffusion: PathDiffusionParams
    unseen: dict[Name, ConstraintParams]
    compare_manifolds: CompareManifoldsParams
    compare_charts: CompareChartsParams
    demonstrations: DemonstrationsParams
    studies: StudyParams
    sweep: SweepParams
    execution: ExecutionParams
    benchmark: BenchmarkParams
    problems: ProblemsParams
    clutter: ClutterParams
    judge: JudgeParams
    recording: RecordingParams
    tracking: TrackingParams

    def policy_settings(self) -> GeodesicParams:
        """How policies are trained, and asked, where curves are retracted."""
        shared = set(PolicyParams.model_fields) & set(GeodesicParams.model_fields)
        return self.geodesics.model_copy(update={n: getattr(self.policies, n) for n in shared})

    @property
    def searched_items(self) -> list[tuple[str, str]]:
        """The pairs (manifold, constraint) whose geodesics are searched."""
        own = self.geodesics
        pairs = [(m, c) for m in own.searched for c in self.constraints]
        pairs += [(m, c) for m in own.illustrated for c in own.illustrated_constraints]
        return list(dict.fromkeys(pairs))

    @property
    def all_constraints(self) -> dict[str, ConstraintParams]:
        """Those of the pipeline, then those that it has not seen."""
        return {**self.constraints, **self.unseen}

    @model_validator(mode="after")
    def _names_exist(self) -> "Params":
        if "free" not in self.constraints or not self.constraints["free"].is_free:
            raise ValueError(
                "constraints.free: must be there with all axes 0, the manifolds are trained on it"
            )
        if self.studies.constraint not in self.constraints:
            raise ValueError(
                f"studies.constraint={self.studies.constraint!r}: must be one of "
                f"{sorted(self.constraints)}"
            )
        if missing := set(self.geodesics.seeds) - set(self.policies.seeds):
            raise ValueError(
                f"geodesics.seeds={sorted(missing)}: must be among policies.seeds, whose policies "
                f"search"
            )
        again = set(self.unseen) & set(self.constraints)
        if again:
            raise ValueError(
                f"unseen={sorted(again)}: these are among the constraints that are trained on"
            )
        geodesics, charts, constraints = self.geodesics, self.compare_charts, self.constraints
        for study, name, taken in (
            ("compare_manifolds.vae", self.compare_manifolds.vae, self.manifolds),
            ("compare_charts.vae", charts.vae, self.manifolds),
            ("demonstrations.learned.vae", self.demonstrations.learned.vae, self.manifolds),
            ("compare_charts.constraint", charts.constraint, constraints),
        ):
            if name not in taken:
                raise ValueError(f"{study}={name!r}: must be one of {sorted(taken)}")
        twice = set(geodesics.searched) & set(geodesics.illustrated)
        if twice:
            line = f"{sorted(twice)[0]!r} is among geodesics.searched: its files are one stage's"
            raise ValueError(f"geodesics.illustrated: {line}")
        for entry, names, known in (
            ("geodesics.searched", geodesics.searched, self.manifolds),
            ("geodesics.illustrated", geodesics.illustrated, self.manifolds),
            ("geodesics.illustrated_constraints", geodesics.illustrated_constraints, constraints),
            ("clutter.constraints", self.clutter.constraints, constraints),
            ("carried.constraints", self.carried.constraints, self.all_constraints),
        ):
            for name in names:
                if name not in known:
                    raise ValueError(f"{entry}={name!r}: must be one of {sorted(known)}")
        return self


MOST_YAML = 16 * 2**20
"""Bytes of a file of YAML, which is read slowly."""
MOST_VALUES = 10**6
"""Values in one."""
LONGEST_SAID = 300
"""Letters of what the parser says of a file."""


def load_params(
    path: Path = Path("params.yaml"), changes: Mapping[str, Any] | None = None
) -> Params:
    """Read and check params.yaml, with other values of some entries, by their paths.

    Raises ParamsError, one line: the file, the entry, its value and what is allowed.
    """
    raw = read_yaml(path)
    for entry, value in (changes or {}).items():
        _change(raw, entry, value, path)
    return params_of(raw, path)


def params_of(raw: Any, path: Path) -> Params:
    """Check what was read of a file.  Raises ParamsError, as `load_params`."""
    try:
        # in JSON's strict mode lists may become tuples, but neither "5" nor true becomes a number
        return Params.model_validate_json(json.dumps(raw, default=str), strict=True)
    except ValidationError as error:
        raise ParamsError(f"{path}: {one_line(error)}") from None


def _change(raw: Any, entry: str, value: Any, path: Path) -> None:
    *outer, last = entry.split(".")
    for name in outer:
        raw = raw.get(name) if isinstance(raw, dict) else None
    if not isinstance(raw, dict) or last not in raw:
        raise ParamsError(f"{path}: {entry}={value!r}: there is no such parameter")
    raw[last] = value


def read_yaml(path: Path) -> Any:
    """A file of YAML 1.2, read as DVC reads and writes it: 2e-05 is a number there, which YAML 1.1
    takes for a text.

    Raises ParamsError, one line, if it can't be read.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        text = read_text(path, most=MOST_YAML)
        documents = list(YAML(typ="safe", pure=True).load_all(text))
        for document in documents:
            _whole_size(document, {})
    except OSError as error:
        raise ParamsError(f"{path}: {error.strerror}") from None
    except (UnicodeError, RecursionError) as error:
        raise ParamsError(f"{path}: not YAML: {str(error).splitlines()[0]}") from None
    except (YAMLError, ValueError) as error:
        said = " ".join(str(error).split())  # which quotes what the file has, however long
        raise ParamsError(f"{path}: not YAML: {said[:LONGEST_SAID]}") from None
    while len(documents) > 1 and documents[-1] is None:  # as after a last `---`
        documents.pop()
    if len(documents) > 1:
        raise ParamsError(f"{path}: has {len(documents)} documents of YAML: must have one")
    return documents[0] if documents else None


def _whole_size(raw: Any, known: dict[int, int | None]) -> int:
    """How many values a document has, those that aliases repeat each time.  Raises ValueError for
    more than MOST_VALUES, for one that holds itself, and for names that are no texts.
    """
    if not isinstance(raw, dict | list):
        return 1
    if id(raw) not in known:
        known[id(raw)] = None  # until it is counted
        if isinstance(raw, dict):
            for name in raw:
                if not isinstance(name, str):
                    raise ValueError(f"{shown(name)} is the name of an entry: must be a text")
        inner = raw.values() if isinstance(raw, dict) else raw
        known[id(raw)] = 1 + sum(_whole_size(value, known) for value in inner)
    size = known[id(raw)]
    if size is None:
        raise ValueError("an entry holds itself, by an alias")
    if size > MOST_VALUES:
        raise ValueError(f"more than {MOST_VALUES} values, by aliases")
    return size


def one_line(error: ValidationError) -> str:
    """What is wrong first: the entry, its value and what is allowed."""
    first = error.errors()[0]
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    where = ".".join(str(part) for part in first["loc"] if not str(part).startswith("<"))
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"{where}={shown(first['input'])}: there is no such parameter{more}"
    if first["type"] == "union_tag_not_found":
        return f"{where}.kind is missing{more}"
    if first["type"] == "missing":
        return f"{where} is missing{more}"
    if first["type"] == "value_error":
        return f"{where + ': ' if where else ''}{message}{more}"
    return f"{where}={shown(first['input'])}: {message[0].lower()}{message[1:]}{more}"
