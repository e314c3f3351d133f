"""The bodies that Drake's SceneGraph poses, as of a MultibodyPlant in a diagram."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import (
    FrameId,
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    QueryObject,
    Role,
    SceneGraph,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from drake_dae.arrays import FloatArray
from drake_dae.pictures.scene.floor import floor_below
from drake_dae.pictures.scene.framing import ViewAngles, direction_of, framed
from drake_dae.pictures.scene.view import ASPECT, CAMERA_ANGLE, draw_floor, look_at

VISUALIZER = ("drake", "visualizer")
"""The path of the links in Meshcat."""


@dataclass(frozen=True, eq=False)
class PosedBodies:
    """Bodies that Drake's SceneGraph poses.

    Attributes:
        scene_graph: It; None if there are no such bodies.
        frames: Their frames.
        links: The name and the path in Meshcat of each.
    """

    scene_graph: SceneGraph | None = None
    frames: Sequence[FrameId] = ()
    links: Sequence[tuple[str, tuple[str, ...]]] = ()

    @classmethod
    def of(
        cls, scene_graph: SceneGraph, plants: Sequence[MultibodyPlant], without: Collection[str]
    ) -> "PosedBodies":
        """The bodies with illustrations that move.

        Args:
            scene_graph: The geometry.
            plants: The plants of Drake's in the diagram, which name their bodies.
            without: The paths in Meshcat of bodies that are drawn otherwise.
        """
        inspector, found = (
            scene_graph.model_inspector(),
            list[tuple[FrameId, str, tuple[str, ...]]](),
        )
        for frame in inspector.GetAllFrameIds():
            path = (*VISUALIZER, *inspector.GetName(frame).split("::"))
            is_drawn = inspector.NumGeometriesForFrameWithRole(frame, Role.kIllustration) > 0
            if frame == inspector.world_frame_id() or not is_drawn or "/".join(path) in without:
                continue
            bodies = (plant.GetBodyFromFrameId(frame) for plant in plants)
            body = next((one for one in bodies if one is not None), None)
            name = inspector.GetName(frame) if body is None else body.scoped_name().get_full()
            found.append((frame, name, path))
        if not found:
            return NO_BODIES
        return cls(scene_graph, [one[0] for one in found], [one[1:] for one in found])

    def poses(self, context: Context) -> FloatArray:
        """12 numbers for each body, R, column by column, and p, in the context of the diagram."""
        if self.scene_graph is None:
            return np.zeros(0)
        query, found = self._query(context), []
        for frame in self.frames:
            pose = query.GetPoseInWorld(frame)
            found.append(np.append(pose.rotation().matrix().flatten("F"), pose.translation()))
        return np.concatenate(found)

    def corners(self, context: Context) -> FloatArray:
        """The corners of the bounding boxes of all that is drawn, m, shape (k, 3)."""
        if self.scene_graph is None:
            return np.zeros((0, 3))
        inspector, query = self.scene_graph.model_inspector(), self._query(context)
        signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1)
        boxes = [np.zeros((0, 3))]
        for geometry in inspector.GetAllGeometryIds(Role.kIllustration):
            try:
                box = inspector.GetObbInGeometryFrame(geometry)
            except RuntimeError:  # A mesh that Drake does not read, or without extent.
                continue
            if box is not None:
                stands = query.GetPoseInWorld(geometry) @ box.pose()
                boxes.append(stands.multiply(signs * box.half_width()[:, None]).T)
        return np.vstack(boxes)

    def draw(self, meshcat: Meshcat, context: Context, is_alone: bool) -> None:
        """Draws them, and, if they are alone, the floor below them, with the camera on them."""
        if self.scene_graph is None:
            return
        viewer = MeshcatVisualizer(meshcat, MeshcatVisualizerParams())
        own = viewer.CreateDefaultContext()
        viewer.query_object_input_port().FixValue(own, self._query(context))
        viewer.ForcedPublish(own)
        seen, none = self.corners(context), np.zeros((0, 3))
        if is_alone and seen.size:
            draw_floor(meshcat, floor_below(seen))
            look_at(
                meshcat,
                *framed(seen, direction_of(seen, none, none), ViewAngles.of(CAMERA_ANGLE, ASPECT)),
            )

    def _query(self, context: Context) -> QueryObject:
        assert self.scene_graph is not None
        own = self.scene_graph.GetMyContextFromRoot(context)
        return self.scene_graph.get_query_output_port().Eval(own)


NO_BODIES = PosedBodies()
"""Where Drake's SceneGraph poses nothing."""
