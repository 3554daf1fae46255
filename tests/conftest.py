import os
from pathlib import Path

import pytest

pytest_plugins = ["pytester"]


@pytest.fixture(scope="session")
def test_data() -> Path:
    """The folder of real data, which is not part of this repository."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("CPAS_TEST_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder} (set CPAS_TEST_DATA)")
    return folder.resolve()
