"""The group that every command belongs to."""

from typing import Any

import click
from posecore.errors import PoseError, exit_code
from posecore.files import storage_error


class CleanGroup(click.Group):
    """A group whose commands end with one line on stderr for every error a user can cause."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; turn PoseError into `Error: ...` and its exit code."""
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
