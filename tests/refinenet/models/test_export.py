import json
import zipfile

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from posecore.errors import CheckpointError, ConfigError
from refinenet.batch import NetworkInput
from refinenet.geometry.poses import PoseUpdate
from refinenet.models import checkpoint, export


@pytest.fixture(scope="module")
def loaded(repository):
    return checkpoint.load(repository / "examples" / "checkpoints" / "tug_compact.safetensors")


@pytest.mark.slow
def test_onnx_gives_the_networks_updates_at_any_batch_size(cli, loaded, tmp_path):
    out = tmp_path / "model.onnx"
    result = cli("export", "--checkpoint", loaded.path, "--out", out)
    assert result.exit_code == 0, result.output
    assert f"{out}: differs from the network by dR" in result.stdout
    session = onnxruntime.InferenceSession(out, providers=["CPUExecutionProvider"])
    inputs = export.random_pairs(7, 64, seed=3)
    dR, dt = session.run(None, {n: x.numpy() for n, x in zip(export.INPUTS[:4], inputs, strict=True)})[:2]
    with torch.no_grad():
        update = loaded.network()(NetworkInput(*inputs))
    np.testing.assert_allclose(dR, update.dR.numpy(), atol=1e-4)
    np.testing.assert_allclose(dt, update.dt.numpy(), atol=1e-5)
    assert np.abs(dt).max() > 1e-3  # the pairs are not ones that nothing is done for
    about = json.loads({p.key: p.value for p in onnx.load(out).metadata_props}["refinenet"])
    assert about["checkpoint_sha256"] == loaded.sha256
    assert (about["patch_px"], about["window"]["kind"]) == (64, "diameter")


@pytest.mark.slow
def test_the_exported_program_gives_the_networks_updates(cli, loaded, tmp_path):
    out = tmp_path / "model.pt2"
    assert cli("export", "--checkpoint", loaded.path, "--out", out).exit_code == 0
    assert zipfile.is_zipfile(out)
    extra = {"refinenet": ""}
    program = torch.export.load(out, extra_files=extra)
    inputs = export.random_pairs(3, 64, seed=4)
    with torch.no_grad():
        dR, dt = program.module()(*inputs)[:2]
        update = loaded.network()(NetworkInput(*inputs))
    torch.testing.assert_close(dR, update.dR, atol=1e-4, rtol=0)
    torch.testing.assert_close(dt, update.dt, atol=1e-5, rtol=0)
    assert json.loads(extra["refinenet"])["step"] == loaded.provenance.step


@pytest.mark.slow
def test_a_file_that_differs_is_not_written(loaded, tmp_path, monkeypatch):
    out = tmp_path / "model.pt2"
    runner = export._program_runner

    def wrong(content):
        run = runner(content)
        return lambda *inputs: {name: values + 1e-3 for name, values in run(*inputs).items()}

    monkeypatch.setattr(export, "_program_runner", wrong)
    with pytest.raises(CheckpointError, match=r"its dR differs by 0.001 from the network's, expected at most 1e-04"):
        export.export(loaded, out)
    assert not out.exists()


@pytest.mark.slow
def test_a_confidence_is_exported_where_there_is_one(tmp_path):
    class Confident(torch.nn.Module):
        def forward(self, pair):
            level = pair.scene_rgb.float().mean(dim=(1, 2, 3)) - pair.hypothesis_rgb.float().mean(dim=(1, 2, 3))
            return PoseUpdate(pair.T_cam_obj[:, :3, :3], pair.T_cam_obj[:, :3, 3], level)

    content = export._onnx(export.FlatNetwork(Confident()).eval(), export.random_pairs(2, 64, seed=1), "{}")
    run = export._onnx_runner(content)
    assert set(run(*export.random_pairs(2, 64, seed=0))) == set(export.OUTPUTS)


def test_wrong_names_and_missing_packages_are_said(cli, loaded, tmp_path, monkeypatch):
    result = cli("export", "--checkpoint", loaded.path, "--out", tmp_path / "model.xml")
    assert result.exit_code == 2
    assert "choose a name ending in .onnx (ONNX) or .pt2 (torch.export)" in result.stderr
    monkeypatch.setattr(export.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        ConfigError, match=r"ONNX needs onnx, onnxscript, onnxruntime.*pip install 'refinenet\[export\]'"
    ):
        export.export(loaded, tmp_path / "model.onnx")
