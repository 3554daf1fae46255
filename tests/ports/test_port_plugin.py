import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("module", "method", "words"),
    [
        ("torch", "sgpa:Sgpa", "needs torch: pip install 'pytest-cpas[torch]'"),
        ("skimage", "sdfest:Sdfest", "needs scikit-image: pip install 'pytest-cpas[sdf]'"),
        ("yaml", "sdfest:Sdfest", "needs PyYAML: pip install 'pytest-cpas[sdf]'"),
    ],
)
def test_what_is_missing_is_asked_for(pytester, module, method, words):
    """One error, before anything runs."""
    code = f"""if True:
        import importlib.util, sys
        real = importlib.util.find_spec
        importlib.util.find_spec = lambda name, *a: None if name == {module!r} else real(name, *a)
        import pytest
        sys.exit(pytest.main(sys.argv[1:]))
    """
    args = [
        "-p",
        "no:dash",
        f"--cpas-method=method_adapters.{method}",
        "--cpas-dataset=synthetic-tabletop",
    ]
    done = subprocess.run([sys.executable, "-c", code, *args], capture_output=True, text=True)
    assert done.returncode == pytest.ExitCode.USAGE_ERROR
    assert words in done.stderr
    assert "Traceback" not in done.stderr


def test_missing_weights_are_one_error(pytester):
    pytest.importorskip("torch", reason="pip install 'pytest-cpas[torch]'")
    args = (
        "-p",
        "no:dash",
        "--cpas-method=method_adapters.sgpa:Sgpa",
        "--cpas-dataset=synthetic-tabletop",
    )
    result = pytester.runpytest_subprocess(*args, "--cpas-weights=nowhere")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    for words in ("nowhere/sgpa/real.pth", "drive.google.com", "no licence stated"):
        assert words in result.stderr.str()
