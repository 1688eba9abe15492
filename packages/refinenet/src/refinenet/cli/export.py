"""`refinenet export`."""

from pathlib import Path

import click

from refinenet.cli.options import FILE, NEW_FILE, verbose_option


@click.command()
@click.option("--checkpoint", required=True, type=FILE, metavar="FILE", help="Trained network (.safetensors).")
@click.option(
    "--out", required=True, type=NEW_FILE, metavar="FILE", help="model.onnx (ONNX) or model.pt2 (torch.export)."
)
@verbose_option
def export(checkpoint: Path, out: Path) -> None:
    """Write a network for other runtimes: one update for a batch of pairs of patches.

    The file is run and compared with the network before it is written.

    \b
    refinenet export --checkpoint best.safetensors --out model.onnx
    refinenet export --checkpoint best.safetensors --out model.pt2
    """
    from posecore.files import require_writable

    from refinenet.models import checkpoint as checkpoints
    from refinenet.models import export as exports

    require_writable(out)
    differences = exports.export(checkpoints.load(checkpoint), out)
    shown = ", ".join(
        f"{name} {value:.1e} (at most {exports.TOLERANCES[name]:.0e})" for name, value in differences.items()
    )
    click.echo(f"{out}: differs from the network by {shown}")
