"""Stage: the configuration of policies that params.yaml describes, its seeds trained and judged."""

import json
import sys

from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.studies.sweep import (
    STAGE,
    Sweep,
    configuration,
    configuration_figures,
    run_sweep,
)
from constraint_geodesics.text_files import write_text
from constraint_geodesics.tracking.store import stable


def main(params: Params, layout: Layout) -> None:
    """Write the configuration's figures; seeds that a sweep has trained before are not trained
    again.
    """
    own = configuration(params, layout, {})
    if own.seeds_left(layout):
        run_sweep(Sweep([own], layout, lambda _: None))
    file = layout.report(STAGE, "configuration")
    figures = stable(configuration_figures(own, layout))
    write_text(file, json.dumps(figures, indent=2, sort_keys=True) + "\n")


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
