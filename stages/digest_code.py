"""Stage: digests of the code that each stage's results hang on, so that DVC sees what changed."""

import sys
from pathlib import Path

from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.code import code_lines
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.text_files import write_text


def main(_: Params, layout: Layout) -> None:
    """Write data/code/<stage>.txt."""
    layout.code.mkdir(parents=True, exist_ok=True)
    for script in sorted(Path(__file__).parent.glob("*.py")):
        write_text(layout.code / f"{script.stem}.txt", code_lines(script))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
