"""`make sweep`: configurations of policies trained and judged in parallel, each kept as a DVC
experiment, and their ranking.
"""

import os
import shutil
import sys
from pathlib import Path

from constraint_geodesics.pipeline.experiments import (
    ExperimentClone,
    ExperimentError,
    experiment_names,
)
from constraint_geodesics.pipeline.layout import SWEEP_FOLDER, Layout
from constraint_geodesics.pipeline.stage import SHOWN, complain
from constraint_geodesics.pipeline.threads import ONE_THREAD
from constraint_geodesics.report.sweep_table import write_ranking
from constraint_geodesics.studies.search_space import read_space
from constraint_geodesics.studies.sweep import (
    Configuration,
    Sweep,
    configurations_of,
    run_sweep,
    tell_ranks,
)
from constraint_geodesics.text_files import write_text
from constraint_geodesics.tracking.store import tracking_uri

TARGET = "stages/sweep/dvc.yaml:sweep_policies"


def main(space: Path) -> None:
    """Train what is not trained, record what is not recorded, and rank after each configuration.

    Raises ExperimentError at the end if DVC did not take an experiment: the next call tries again.
    """
    layout, failed = Layout(Path().resolve()), list[str]()
    configurations = configurations_of(read_space(space), layout)
    known = experiment_names(layout.root)
    environment = {
        SWEEP_FOLDER: str(layout.sweep),
        "MLFLOW_TRACKING_URI": tracking_uri(layout.root),
    }
    clone = ExperimentClone(layout.root, layout.sweep / "checkout", environment)
    shutil.rmtree(clone.folder, ignore_errors=True)  # that of an earlier commit

    def finished(own: Configuration) -> None:
        mark, seeds = layout.sweep / own.name / "experiment.txt", str(own.params.sweep.seeds)
        if own.name in known and mark.is_file() and mark.read_text() == seeds:
            return
        write_ranking(configurations, layout)
        try:
            clone.run(own.name, own.changes, TARGET)
            write_text(mark, seeds)
        except ExperimentError as error:
            failed.append(str(error))

    sweep = Sweep(configurations, layout, finished)
    run_sweep(sweep)
    ranked = write_ranking(configurations, layout)
    tell_ranks(sweep, ranked)
    if failed:
        raise ExperimentError(f"{len(failed)} experiments are not recorded, the first: {failed[0]}")


if __name__ == "__main__":
    os.environ.update(ONE_THREAD)
    try:
        main(Path(sys.argv[1]))
    except SHOWN as error:
        raise SystemExit(complain(error)) from None
