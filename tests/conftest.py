"""What all tests share: one thread per renderer and per matrix library, and the real data where it is there."""

import os
from pathlib import Path

# Before anything opens a GL context or imports torch: test processes run side by side, and Mesa and OpenMP would start
# a thread per core in each.
os.environ.setdefault("LP_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
SHARED_DATA_VARIABLE = "POSE_SHARED_DATA"


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root folder of the repository."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with real test data (LM-O frames, meshes, photographs); the test is skipped where it is missing."""
    folder = Path(os.environ.get(SHARED_DATA_VARIABLE, REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no test data at {folder}; set {SHARED_DATA_VARIABLE} to the folder that has lmo/ and meshes/")
    return folder


@pytest.fixture(scope="session")
def tug_ply() -> Path:
    """The example object without any symmetry: vertex colours, millimetres, origin at the box centre."""
    return REPOSITORY / "examples" / "objects" / "tug.ply"


@pytest.fixture(scope="session")
def bobbin_ply() -> Path:
    """The example object that looks the same after any turn about z."""
    return REPOSITORY / "examples" / "objects" / "bobbin.ply"
