"""The error tree. Every message is one line: where, what was found, what was expected, what to do."""


class PoseError(Exception):
    """Root of all errors that a user can cause or has to handle."""


class MeshError(PoseError, ValueError):
    """A mesh file cannot be used."""


class TextureError(MeshError):
    """A file that a mesh's material names is missing."""


class CameraError(PoseError, ValueError):
    """A camera matrix or image size is invalid."""


class DatasetError(PoseError, ValueError):
    """A BOP dataset folder is incomplete or inconsistent."""


class ResultFileError(PoseError, ValueError):
    """A BOP result file breaks the format; the message names file and line."""


class ShardError(PoseError, ValueError):
    """A shard dataset is truncated, of another schema, or no dataset."""


class ConfigError(PoseError, ValueError):
    """A configuration key or value is wrong; the message names the key."""


class CheckpointError(PoseError, ValueError):
    """A checkpoint cannot be loaded or belongs to another network or object."""


class RenderError(PoseError, RuntimeError):
    """A renderer failed or has no device to run on."""


class StorageError(PoseError, OSError):
    """A file or folder cannot be read or written (rights, full disk)."""


def exit_code(error: PoseError) -> int:
    """Return the process exit code for an error: 2 for wrong usage or configuration, 1 for everything else."""
    return 2 if isinstance(error, ConfigError) else 1
