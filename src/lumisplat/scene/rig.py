"""A rig: meshes that joints move, and the clips that move the joints."""

from __future__ import annotations

from dataclasses import dataclass

from lumisplat.scene.mesh import Mesh


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Meshes bound to a hierarchy of joints, with animations by name; made by `load_rig`.

    A pose is linear blend skinning (glTF 2.0 section 3.7.3) of the vertices after their morph targets. All poses are
    in the file's world space, with its axes (glTF: y up, +z towards the viewer).
    """

    @property
    def clips(self) -> tuple[str, ...]:
        """Names of the clips, in the file's order; those without a name are called by their number."""
        raise NotImplementedError

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        """The meshes at rest, one a material: joints where the nodes of the file put them, as `load` shows them."""
        raise NotImplementedError

    @property
    def mesh(self) -> Mesh:
        """The mesh at rest, of a rig that has one only.

        Raises:
            SceneError: It has several: see `meshes`.
        """
        raise NotImplementedError

    def duration(self, clip: str | None = None) -> float:
        """Time of the last key of a clip, seconds.

        Args:
            clip: Its name; None: the first.

        Raises:
            SceneError: There is no such clip; lists those there are.
        """
        raise NotImplementedError

    def pose(self, time: float, clip: str | None = None) -> Mesh:
        """The mesh at a time of a clip, of a rig that has one only; see `poses`.

        Raises:
            SceneError: The rig has several meshes, there is no such clip, or the time is not finite.
        """
        raise NotImplementedError

    def poses(self, time: float, clip: str | None = None) -> tuple[Mesh, ...]:
        """The meshes at a time of a clip, with normals.

        Args:
            time: Seconds; before the first key and after the last the pose holds.
            clip: Its name; None: the first, and the pose at rest if there is none.

        Returns:
            One mesh a material, without those that the clip scales to nothing at that time.

        Raises:
            SceneError: There is no such clip, or the time is not finite.
        """
        raise NotImplementedError
