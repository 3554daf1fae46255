import importlib.util
import os
from pathlib import Path

import pytest

# without torch these files cannot even be imported; test_port_plugin.py says so
if importlib.util.find_spec("torch") is None:
    collect_ignore_glob = ["test_port_[!p]*.py"]
else:
    import torch

    # beside other workers, more threads only get in each other's way
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def shared_ports() -> Path:
    """Inputs and outputs of the original networks, which are not part of this repository."""
    default = Path(__file__).parents[3] / "shared" / "ports"
    folder = Path(os.environ.get("CPAS_TEST_PORTS", default))
    if not folder.is_dir():
        pytest.skip(f"no parity data at {folder} (set CPAS_TEST_PORTS)")
    return folder.resolve()
