"""`synthgen info`."""

import click


@click.command()
@click.argument("dataset", type=str)
@click.option("--json", "as_json", is_flag=True, help="One JSON object instead of text.")
def info(dataset: str, as_json: bool) -> None:
    """Say what a DATASET holds and how it was made: folder or URL of shards, or a folder of `synthgen bop`.

    \b
    synthgen info shards
    synthgen info s3://bucket/shards --json
    """
    import json

    from synthgen.inspect.info import dataset_info, info_text

    found = dataset_info(dataset)
    click.echo(json.dumps(found, indent=1) if as_json else info_text(found))
