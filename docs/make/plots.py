"""The plots that dvc.yaml names, of several commits in one page that opens offline: `make plots
FROM=… TO=…`.

DVC's own page loads its chart library from the net; here the same library stands in the page.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import vl_convert
import yaml

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / ".geodesics" / "plots"
PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>{revisions}</title>
<script>
{library}
</script>
</head>
<body style="font-family: sans-serif">
<h1>{revisions}</h1>
{plot_divs}
</body>
</html>
"""


def page_of(revisions: list[str]) -> str:
    """The page's frame as DVC fills it in, with the chart library inside."""
    library = vl_convert.javascript_bundle().replace("</script", "<\\/script")
    return PAGE.replace("{revisions}", " and ".join(revisions)).replace("{library}", library)


def main(revisions: list[str]) -> int:
    """Write .geodesics/plots/index.html; the exit code is DVC's."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    titles = [next(iter(plot)) for plot in yaml.safe_load((ROOT / "dvc.yaml").read_text())["plots"]]
    with tempfile.TemporaryDirectory() as folder:
        frame = Path(folder) / "page.html"
        frame.write_text(page_of(revisions))
        command = [
            "dvc",
            "plots",
            "diff",
            *revisions,
            "--html-template",
            str(frame),
            "-o",
            str(FOLDER),
        ]
        done = subprocess.run([*command, "--targets", *titles], cwd=ROOT, check=False)
    return done.returncode


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
