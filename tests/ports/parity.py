"""The comparison with recorded inputs and outputs of the original networks, which are shared data
and not part of this repository."""

import json

import cases
import numpy as np
import pytest
import recipe


def read(shared_ports, name):
    with np.load(shared_ports / "parity" / f"{name}.npz") as file:
        return dict(file)


def weights(shared_ports, inventory, data):
    """The recipe's weights by the published names, with which ``data`` was made."""
    entries = json.loads((shared_ports / "inventory" / f"{inventory}.json").read_text())
    # CASS's grid is no weight, and is not hashed
    entries = [entry for entry in entries if not entry[0].endswith("grid_buf")]
    state = recipe.state_dict(entries, int(data["weights_seed"]))
    assert recipe.sha256(state) == str(data[f"weights_sha256__{inventory}"])
    return state


def tap(network, data, seen):
    """From now on, what the submodules that ``data`` has taps of return is put into ``seen``."""
    calls = {}

    def hook(path):
        def keep(module, arguments, result):
            call = calls[path] = calls.get(path, -1) + 1
            parts = result if isinstance(result, tuple) else (result,)
            seen.update({f"tap__{path}__call{call}__out{j}": x for j, x in enumerate(parts)})

        return keep

    for path in {key.split("__")[1] for key in data if key.startswith("tap__")}:
        network.get_submodule(path).register_forward_hook(hook(path))


def compare(seen, data, tolerance=cases.TOLERANCE):
    """Every output and tap of the original is in ``seen`` and agrees; returns how many."""
    checked = 0
    for key in data:
        base = key.removesuffix("__sub")
        if not key.startswith(("output__", "tap__")) or key.endswith(("stride", "shape", "__l2")):
            continue
        ours, expected = seen[base].numpy(), np.ravel(data[key])
        thin = ours.ravel()
        if base != key:
            assert ours.shape == tuple(data[f"{base}__shape"]), key
            thin = thin[:: int(data[f"{base}__stride"])]
        else:
            assert ours.shape == data[key].shape, key
        difference = cases.relative(thin, expected)
        assert difference <= tolerance, f"{key}: {difference:.2e}"
        if expected.size > 1:
            middle = expected.mean()  # what is nearly constant must not hide behind its mean
            assert cases.relative(thin - middle, expected - middle) <= 1e-4, key
        if f"{base}__l2" in data:
            length = np.linalg.norm(ours.astype(np.float64))
            assert length == pytest.approx(float(data[f"{base}__l2"]), rel=tolerance)
        checked += 1
    return checked
