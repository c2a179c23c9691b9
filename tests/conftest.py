"""Options that only tests and the command line may set, and fixtures that all tests share."""

import gc
import os
from pathlib import Path

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # before jax: the compilation cache is noisy otherwise
os.environ.setdefault("MPLBACKEND", "Agg")

import jax
import pytest

ROOT = Path(__file__).resolve().parents[1]

# Compiled programs are kept between runs of the suite; deleting .pytest_cache forgets them. The environment variable
# keeps the command line, which tests call in this process and in others, from choosing a folder of its own.
CACHE = str(ROOT / ".pytest_cache" / "jax")
os.environ["JAX_COMPILATION_CACHE_DIR"] = CACHE
jax.config.update("jax_compilation_cache_dir", CACHE)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)


MAPS = Path("/proc/self/maps")
MANY = 16_000


@pytest.fixture(autouse=True, scope="module")
def few_programs():
    """Between modules, forget compiled programs where there are very many.

    Each takes several of the 65,530 memory maps that Linux allows a process; beyond them the compiler crashes.
    """
    yield
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > MANY:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="session")
def root() -> Path:
    """The root of the project."""
    return ROOT


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real meshes, volumes and environment maps beside the project; tests that need them skip where they are absent."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("real input data (../shared/data) is not on this machine")
    return folder
