"""Run docs/first_path.ipynb and store its outputs: `make notebook`.

The kernel is the documentation's Python with the project's packages before its own, so nothing of
Jupyter is needed beside the project.
"""

import os
import sys
import tempfile
from pathlib import Path

import nbformat
from jupyter_client.kernelspec import KernelSpec
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOK = ROOT / "docs" / "first_path.ipynb"


class _Manager(AsyncKernelManager):
    """Starts the kernel with this Python, whatever kernels are installed on the machine."""

    @property
    def kernel_spec(self) -> KernelSpec:
        """The one kernel."""
        return KernelSpec(
            argv=[sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
        )


def main() -> None:
    """Run every cell from the start; write the notebook with what was printed and drawn, without
    times of the run.
    """
    packages = next((ROOT / ".venv" / "lib").glob("python*/site-packages"))
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(packages)]),
        "OMP_NUM_THREADS": "1",
    }
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(
            notebook,
            # a socket that is a file, where both sides find it: nothing listens on the network
            km=_Manager(transport="ipc", ip=str(Path(folder) / "kernel")),
            timeout=300,
            record_timing=False,
            resources={"metadata": {"path": folder}},
        )
        client.execute(env=environment, cwd=folder)
    notebook.metadata = {"language_info": {"name": "python"}}
    nbformat.validate(notebook)
    nbformat.write(notebook, NOTEBOOK)
    print(f"{NOTEBOOK.relative_to(ROOT)}: {NOTEBOOK.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
