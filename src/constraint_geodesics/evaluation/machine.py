"""What timings were taken on."""

import platform
from pathlib import Path

import torch


def machine() -> dict[str, str]:
    """Processor, Python and torch; one thread, to which every benchmark here keeps."""
    cpuinfo = Path("/proc/cpuinfo")  # Linux only; elsewhere the platform's own word must do
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    named = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    processor = named[0] if named else platform.processor() or platform.machine()
    return {"processor": processor, "python": platform.python_version(), "torch": torch.__version__, "threads": "1"}
