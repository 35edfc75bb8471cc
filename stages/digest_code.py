"""Stage: digests of the code that each stage's results hang on, so that DVC sees what changed."""

import sys
from pathlib import Path

import constraint_geodesics
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.code import code_of
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.text_files import write_text


def main(_: Params, layout: Layout) -> None:
    """Write data/code/<stage>.txt: a line a file, so that two of them can be compared."""
    package = Path(constraint_geodesics.__file__).parent
    layout.code.mkdir(parents=True, exist_ok=True)
    for script in sorted(Path(__file__).parent.glob("*.py")):
        lines = [f"{digest}  {name}\n" for name, digest in code_of(script, package).items()]
        write_text(layout.code / f"{script.stem}.txt", "".join(lines))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
