"""The bodies that Drake's SceneGraph poses, for example those of a MultibodyPlant in a diagram."""

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
"""The path in Meshcat that contains the links."""


@dataclass(frozen=True, eq=False)
class PosedBodies:
    """Bodies that Drake's SceneGraph poses.

    Attributes:
        scene_graph: The SceneGraph; None if there are no such bodies.
        frames: The frames of the bodies.
        links: The name and the path in Meshcat of each body.
    """

    scene_graph: SceneGraph | None = None
    frames: Sequence[FrameId] = ()
    links: Sequence[tuple[str, tuple[str, ...]]] = ()

    @classmethod
    def of(
        cls, scene_graph: SceneGraph, plants: Sequence[MultibodyPlant], without: Collection[str]
    ) -> "PosedBodies":
        """Returns the moving bodies with illustration geometry.

        Args:
            scene_graph: The geometry.
            plants: Drake's own plants in the diagram, which contain the names of the bodies.
            without: The paths in Meshcat of bodies that are drawn in another way.
        """
        inspector = scene_graph.model_inspector()
        links = dict[FrameId, tuple[str, tuple[str, ...]]]()
        for frame in inspector.GetAllFrameIds():
            path = (*VISUALIZER, *inspector.GetName(frame).split("::"))
            is_drawn = inspector.NumGeometriesForFrameWithRole(frame, Role.kIllustration) > 0
            if frame == inspector.world_frame_id() or not is_drawn or "/".join(path) in without:
                continue
            bodies = (plant.GetBodyFromFrameId(frame) for plant in plants)
            body = next((body for body in bodies if body is not None), None)
            name = inspector.GetName(frame) if body is None else body.scoped_name().get_full()
            links[frame] = (name, path)
        return cls(scene_graph, [*links], [*links.values()]) if links else NO_BODIES

    def poses(self, context: Context) -> FloatArray:
        """Returns 12 numbers for each body, R by columns and p, in a context of the diagram."""
        if self.scene_graph is None:
            return np.zeros(0)
        query = self._query(context)
        poses = [query.GetPoseInWorld(frame) for frame in self.frames]
        return np.concatenate(
            [np.append(X.rotation().matrix().flatten("F"), X.translation()) for X in poses]
        )

    def corners(self, context: Context) -> FloatArray:
        """Returns the corners of the bounding boxes of all drawn geometry, m, shape (k, 3)."""
        if self.scene_graph is None:
            return np.zeros((0, 3))
        inspector, query = self.scene_graph.model_inspector(), self._query(context)
        signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1)
        boxes = [np.zeros((0, 3))]
        for geometry in inspector.GetAllGeometryIds(Role.kIllustration):
            try:
                box = inspector.GetObbInGeometryFrame(geometry)
            except RuntimeError:  # The mesh is empty, or Drake cannot read it.
                continue
            if box is not None:
                pose = query.GetPoseInWorld(geometry) @ box.pose()
                boxes.append(pose.multiply(signs * box.half_width()[:, None]).T)
        return np.vstack(boxes)

    def draw(self, meshcat: Meshcat, context: Context, is_alone: bool) -> None:
        """Draws the bodies; if there are no robots, also draws a floor and sets the camera."""
        if self.scene_graph is None:
            return
        viewer = MeshcatVisualizer(meshcat, MeshcatVisualizerParams())
        viewer_context = viewer.CreateDefaultContext()
        viewer.query_object_input_port().FixValue(viewer_context, self._query(context))
        viewer.ForcedPublish(viewer_context)
        corners, none = self.corners(context), np.zeros((0, 3))
        if is_alone and corners.size:
            draw_floor(meshcat, floor_below(corners))
            direction = direction_of(corners, none, none)
            look_at(meshcat, *framed(corners, direction, ViewAngles.of(CAMERA_ANGLE, ASPECT)))

    def _query(self, context: Context) -> QueryObject:
        assert self.scene_graph is not None
        scene_context = self.scene_graph.GetMyContextFromRoot(context)
        return self.scene_graph.get_query_output_port().Eval(scene_context)


NO_BODIES = PosedBodies()
"""The bodies of a diagram in which Drake's SceneGraph poses none."""
