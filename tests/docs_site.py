"""The documentation's site, as `make docs` makes it."""

import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MKDOCS = ROOT / ".geodesics" / "docs-venv" / "bin" / "mkdocs"
NO_MKDOCS = pytest.mark.skipif(not MKDOCS.is_file(), reason="no mkdocs: `make docs` installs it")
NOTEBOOK_PAGE = "first_path_notebook.md"


def built(folder: Path) -> Path:
    """The site in a folder.  Raises AssertionError with what MkDocs says if it can't be built."""
    command = [str(MKDOCS), "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder
