"""Where figures are from: what they were taken on, of which commit, and when."""

import hashlib
import platform
import subprocess
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path


def machine() -> dict[str, str]:
    """Processor, Python and torch; one thread, to which every benchmark here keeps."""
    cpuinfo = Path("/proc/cpuinfo")  # Linux only; elsewhere the platform's own word must do
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    named = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    processor = named[0] if named else platform.processor() or platform.machine()
    return {
        "processor": processor,
        "python": platform.python_version(),
        "torch": metadata.version("torch"),
        "threads": "1",
    }


def git_says(root: Path, *words: str) -> str:
    """What git says of a folder; nothing where it fails or there is none."""
    command = ["git", "--no-optional-locks", "-C", str(root), *words]
    try:
        said = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return said.stdout.strip() if said.returncode == 0 else ""


def run_header(root: Path) -> dict[str, str]:
    """Where a report is from: commit and digest of dvc.lock, blank where there is none, date, and
    `machine`.
    """
    lock = root / "dvc.lock"
    return {
        "commit": git_says(root, "rev-parse", "HEAD"),
        "dvc.lock": hashlib.sha256(lock.read_bytes()).hexdigest() if lock.is_file() else "",
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        **machine(),
    }
