"""Methods where they live: in another interpreter, in a container, on another host.

:mod:`pytest_cpas.remote.worker` runs there and knows nothing of this package;
:class:`RemoteMethod` stands for it here.
"""

from pytest_cpas.remote.method import RemoteMethod, remote_method
from pytest_cpas.remote.named import named_methods, project_folder, spec_of
from pytest_cpas.remote.process import WorkerError, close_all
from pytest_cpas.remote.reached import OtherSide, RaisedThereError
from pytest_cpas.remote.spec import Spec

__all__ = [
    "OtherSide",
    "RaisedThereError",
    "RemoteMethod",
    "Spec",
    "WorkerError",
    "close_all",
    "named_methods",
    "project_folder",
    "remote_method",
    "spec_of",
]
