"""`synthgen info`."""

import click


@click.command()
@click.argument("dataset", type=str)
@click.option("--json", "as_json", is_flag=True, help="One JSON object instead of text.")
def info(dataset: str, as_json: bool) -> None:
    """Summarise the content and the settings of a DATASET: folder or URL of shards, or a folder of `synthgen bop`.

    \b
    synthgen info shards
    synthgen info s3://bucket/shards --json
    """
    import json

    from synthgen.inspect.info import dataset_info, info_text

    content = dataset_info(dataset)
    click.echo(json.dumps(content, indent=1) if as_json else info_text(content))
