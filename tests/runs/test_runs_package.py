import subprocess
import sys

import pytest

from vsearch_jax import runs


def test_every_public_name_is_there() -> None:
    for name in runs.__all__:
        assert callable(getattr(runs, name)), name
    assert set(runs.__all__) <= set(dir(runs))
    with pytest.raises(AttributeError, match="no attribute 'bogus'"):
        _ = runs.bogus


def test_the_folder_module_does_not_import_jax() -> None:
    code = "import sys; from vsearch_jax.runs import folder, make_new_folder; print('jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
