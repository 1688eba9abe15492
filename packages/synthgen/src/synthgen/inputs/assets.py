"""Assets of a dataset beside its objects: photographs, panoramas and occluder meshes."""

from dataclasses import dataclass

from posecore.files import sha256_bytes, sha256_file
from posecore.mesh import Mesh


@dataclass(frozen=True, kw_only=True, eq=False)
class Assets:
    """Files and meshes that scenes draw from, sorted by name, because their order affects the draws.

    Attributes:
        photos: Background photographs, readable on every worker.
        hdris: Panoramas, readable on every worker.
        occluders: Occluder meshes in their original size; without any, primitive shapes.
    """

    photos: tuple[str, ...] = ()
    hdris: tuple[str, ...] = ()
    occluders: tuple[Mesh, ...] = ()

    def card(self) -> dict[str, dict[str, int | str] | None]:
        """Counts and content hashes for the data card; None for absent kinds."""
        return {
            "backgrounds": {"photos": len(self.photos), "sha256": _hash(self.photos)} if self.photos else None,
            "hdris": {"files": len(self.hdris), "sha256": _hash(self.hdris)} if self.hdris else None,
            "occluders": {
                "meshes": len(self.occluders),
                "sha256": sha256_bytes("".join(m.sha256 for m in self.occluders).encode()),
            }
            if self.occluders
            else None,
        }


def _hash(paths: tuple[str, ...]) -> str:
    return sha256_bytes("".join(sha256_file(p) for p in paths).encode())
