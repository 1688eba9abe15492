"""`synthgen info`."""

from pathlib import Path

import click


@click.command()
@click.argument("shards", required=False, type=str)
@click.option(
    "--dataset", type=click.Path(path_type=Path), metavar="DIR", help="BOP dataset of `synthgen bop` instead."
)
@click.option("--json", "as_json", is_flag=True, help="One JSON object instead of text.")
def info(shards: str | None, dataset: Path | None, as_json: bool) -> None:
    """Summarise the content and the settings of SHARDS (folder or URL), or of a dataset of `synthgen bop`.

    \b
    synthgen info shards
    synthgen info s3://bucket/shards --json
    synthgen info --dataset shards/test_bop
    """
    import json

    from synthgen.inspect.info import dataset_info, info_text, is_bop_dataset

    path = str(dataset) if shards is None else shards
    if (shards is None) == (dataset is None):
        raise click.UsageError("give SHARDS, or --dataset DIR for a BOP dataset")
    if is_bop_dataset(path) and dataset is None:
        raise click.UsageError(f"synthgen info {path} is now synthgen info --dataset {path}, since it is a BOP dataset")
    if dataset is not None and not is_bop_dataset(path):
        raise click.UsageError(f"--dataset {path}: expected a dataset of `synthgen bop`; shards need no --dataset")
    content = dataset_info(path)
    click.echo(json.dumps(content, indent=1) if as_json else info_text(content))
