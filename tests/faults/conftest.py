"""What is broken on purpose is broken as often as the run's options say."""

import pytest

from tests.faults.effort import FAULTS, QUICK, SOAK, Effort


@pytest.fixture(scope="session")
def effort(request: pytest.FixtureRequest) -> Effort:
    """Of this run: `--faults`, `--soak`, or `QUICK`."""
    if request.config.getoption("soak"):
        return SOAK
    return FAULTS if request.config.getoption("faults") else QUICK
