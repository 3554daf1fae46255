"""Our networks and the published ones, each where cpas_toolbox is installed (see published.py),
value by value under the map of names that is proposed."""

import published
import pytest
import torch

from pytest_cpas.stages import TorchTaps, hearing
from pytest_cpas.traces.comparing import compare
from pytest_cpas.traces.maps import read_map
from pytest_cpas.traces.proposing import map_text, propose
from pytest_cpas.traces.recording import Recorder, Trace

pytest.importorskip("cpas_toolbox", reason="pip install --no-deps cpas_toolbox==1.0.0")

pytestmark = pytest.mark.filterwarnings("ignore")

#: Of each network: the values that both name, and, among them, what ours returns.
NETWORKS = {
    "spd": (105, {"assign", "deltas"}),
    "crnet": (267, {"assign", "deltas"}),
    "sgpa": (402, {"structure", "assign", "deltas"}),
    "dpdn": (454, {"attention", "shape", "rotation", "translation", "size"}),
    "cass": (176, {"estimator.posing", "offset", "confidence", "foldingnet.reconstructing"}),
    "asmnet": (32, {"shape", "quaternion"}),
    "rbppose": (48, {"green", "red", "translation", "size", "deltas"}),
    "icaps_aae": (27, {"encoder", "decoder"}),
    "icaps_latentnet": (119, {"cls_layer"}),
    "icaps_deepsdf": (10, {"network"}),
}


def traced(net, ask):
    recorder = Recorder()
    with hearing(recorder), TorchTaps(net), torch.inference_mode():
        ask(net)
    return Trace(values=recorder.values)


@pytest.mark.parametrize("name", NETWORKS)
def test_parity_at_every_shared_stage(tmp_path, monkeypatch, name):
    shared, outputs = NETWORKS[name]
    peer = published.importer(monkeypatch)
    ours, theirs, ask, ask_theirs = getattr(published, name)(peer, monkeypatch.setattr)
    loaded = theirs.load_state_dict(ours.state_dict(), strict=False)
    assert not loaded.unexpected_keys
    own, reference = traced(ours, ask), traced(theirs.eval(), ask_theirs)
    (tmp_path / "parity.toml").write_text(map_text([propose(own, reference)]))
    found = compare(own, read_map(tmp_path / "parity.toml").applied(reference))
    assert found.parting is None, found.parting
    assert len(found.differences) >= shared
    names = {each.name.removeprefix("network.") for each in found.differences}
    assert outputs <= names
