"""How every command of `synthgen` fails: in one line."""

from typing import Any

import click
from posecore.errors import PoseError, exit_code


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
            from posecore.files import storage_error

            click.echo(f"Error: {storage_error(error.filename or 'storage', error)}", err=True)
            ctx.exit(1)
