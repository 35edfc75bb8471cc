"""Where the stages put things, relative to the checkout: data/ belongs to DVC's cache, reports/ to
git.
"""

import os
from dataclasses import dataclass
from pathlib import Path

SWEEP_FOLDER = "GEODESICS_SWEEP"
"""The environment's name of the folder in which a sweep finds what is done."""
RECORDINGS = "data/recordings"
"""Where the stages' recordings lie, relative to the checkout."""


def in_checkout(recording: str) -> str:
    """Where a recording lies in any checkout: a table may have come from another folder, with that
    one's name.
    """
    before, found, after = recording.partition(f"{RECORDINGS}/")
    return found + after if found else before


@dataclass(frozen=True)
class Layout:
    """The files of one checkout."""

    root: Path = Path()

    def joints(self, constraint: str) -> Path:
        """Labelled joint configurations of one constraint (parquet)."""
        return self.root / "data" / "joints" / constraint / "joints.parquet"

    def queries(self, constraint: str) -> Path:
        """Start and goal pairs of one constraint (CSV)."""
        return self.root / "data" / "joints" / constraint / "queries.csv"

    def manifold(self, manifold: str) -> Path:
        """Folder of one learned manifold (safetensors and JSON)."""
        return self.root / "data" / "manifolds" / manifold

    def submanifold(self, manifold: str, constraint: str) -> Path:
        """Folder of one constraint's sub-manifold in one latent space (npz and JSON)."""
        return self.root / "data" / "submanifolds" / f"{manifold}-{constraint}"

    @property
    def submanifolds(self) -> Path:
        """Folder of all of them."""
        return self.root / "data" / "submanifolds"

    def geodesics(self, manifold: str, constraint: str) -> Path:
        """Folder of the policies and curves found (safetensors, npz, CSV)."""
        return self.root / "data" / "geodesics" / f"{manifold}-{constraint}"

    @property
    def code(self) -> Path:
        """Folder of the digests of the code of each stage (text)."""
        return self.root / "data" / "code"

    @property
    def planner(self) -> Path:
        """Folder of the planner's files (safetensors and JSON)."""
        return self.root / "data" / "planner"

    @property
    def learned(self) -> Path:
        """Folder of the learned method's files (safetensors and JSON)."""
        return self.root / "data" / "learned"

    @property
    def pretrained(self) -> Path:
        """Their copy that travels with the package."""
        return self.root / "src" / "constraint_geodesics" / "pretrained"

    def benchmark_queries(self, constraint: str) -> Path:
        """The benchmark's queries of one constraint, with their obstacles (CSV)."""
        return self.root / "data" / "benchmark_queries" / f"{constraint}.csv"

    @property
    def stage_times(self) -> Path:
        """How long each stage took when it last ran (CSV)."""
        return self.root / "reports" / "stage_times.csv"

    @property
    def benchmark_rows(self) -> Path:
        """Folder of the benchmark's rows as they come (JSON lines)."""
        return self.root / "data" / "benchmark_rows"

    @property
    def arm_rows(self) -> Path:
        """Folder of the rows of the study of arms and goals, a file a part (JSON)."""
        return self.root / "data" / "arm_rows"

    @property
    def problem_rows(self) -> Path:
        """Folder of the rows on problems from files, a file a scene (JSON lines)."""
        return self.root / "data" / "problem_rows"

    @property
    def clutter_rows(self) -> Path:
        """Folder of the rows among random shapes, a file a scene and constraint (JSON lines)."""
        return self.root / "data" / "clutter_rows"

    @property
    def benchmark_table(self) -> Path:
        """The benchmark's rows, all together (CSV)."""
        return self.root / "reports" / "benchmark.csv"

    @property
    def training_times(self) -> Path:
        """Seconds that were trained for each planner of the benchmark, when it was run (JSON)."""
        return self.root / "reports" / "benchmark_training.json"

    @property
    def benchmark_recordings(self) -> Path:
        """Folder of the recordings of some of the benchmark's paths."""
        return self.root / "data" / "recordings" / "run_benchmark"

    def policies(self, manifold: str) -> Path:
        """Folder of the policies trained on all constraints together."""
        return self.root / "data" / "policies" / manifold

    @property
    def path_diffusion(self) -> Path:
        """Folder of the diffusion model of paths (safetensors and JSON)."""
        return self.root / "data" / "path_diffusion"

    @property
    def sweep(self) -> Path:
        """Folder of what a sweep has found so far, a folder a configuration (JSON).  An experiment
        runs in a copy of the checkout: there it is the folder of the checkout that started it.
        """
        started = os.environ.get(SWEEP_FOLDER)
        return Path(started) if started else self.root / ".geodesics" / "sweep"

    def analytic(self, manifold: str) -> Path:
        """Folder of the policies and curves found on an analytic manifold."""
        return self.root / "data" / "analytic" / manifold

    def benchmark(self, constraint: str) -> Path:
        """Folder of the sampled paths (npz)."""
        return self.root / "data" / "benchmark" / constraint

    def executions(self, constraint: str) -> Path:
        """Folder of what became of executed paths, for their recordings (npz)."""
        return self.root / "data" / "executions" / constraint

    def recordings(self, stage: str, item: str) -> Path:
        """Folder of the Rerun recordings of one stage's item."""
        return self.root / "data" / "recordings" / stage / item

    def report(self, stage: str, item: str, suffix: str = "json") -> Path:
        """A stage's committed metrics or table."""
        return self.root / "reports" / stage / f"{item}.{suffix}"

    def scratch(self, stage: str, item: str) -> Path:
        """Checkpoints of unfinished work; never an output, so DVC leaves it alone."""
        return self.root / ".geodesics" / stage / item
