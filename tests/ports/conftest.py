import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_ports() -> Path:
    """Inputs and outputs of the original networks, which are not part of this repository."""
    default = Path(__file__).parents[3] / "shared" / "ports"
    folder = Path(os.environ.get("CPAS_TEST_PORTS", default))
    if not folder.is_dir():
        pytest.skip(f"no parity data at {folder} (set CPAS_TEST_PORTS)")
    return folder.resolve()
