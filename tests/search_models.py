"""Viewpoint models of the search for tests, which take longer than a search."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields

import numpy as np
import pytest
from posecore.mesh import Mesh
from posecore.raster import Rasteriser
from refinenet.baselines import global_search
from refinenet.baselines.viewpoint_model import ViewpointModel, make_viewpoint_model


@contextmanager
def models_made_once() -> Iterator[None]:
    """Have the searches of this process make one model of a mesh: it depends on nothing else."""
    models: dict[str, ViewpointModel] = {}

    def made_once(obj_id: int, mesh: Mesh, rasteriser: Rasteriser) -> ViewpointModel:
        key = digest(mesh)
        if key not in models:
            models[key] = make_viewpoint_model(obj_id, mesh, rasteriser)
        return models[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(global_search, "make_viewpoint_model", made_once)
        yield


def digest(mesh: Mesh) -> str:
    """SHA-256 of all of a mesh but where it is from."""
    assert not mesh.levels  # the search draws simplified meshes
    found = hashlib.sha256()
    for field in fields(mesh):
        if field.name in ("path", "sha256"):
            continue
        value = getattr(mesh, field.name)
        found.update(field.name.encode())
        found.update(np.ascontiguousarray(value).tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return found.hexdigest()
