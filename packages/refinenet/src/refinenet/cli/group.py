"""The group that every command belongs to."""

from typing import Any

import click
from posecore.errors import PoseError, exit_code
from posecore.files import storage_error


class CleanGroup(click.Group):
    """Turns the project's errors into one line on stderr and an exit code, never a traceback."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command."""
        try:
            return super().invoke(ctx)
        except PoseError as error:
            click.echo(f"Error: {error}", err=True)
            ctx.exit(exit_code(error))
        except BrokenPipeError:  # `| head` has read enough: click ends quietly
            raise
        except OSError as error:
            click.echo(f"Error: {storage_error(error.filename or 'storage', error)}", err=True)
            ctx.exit(1)
