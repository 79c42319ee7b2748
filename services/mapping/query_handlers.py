"""Queries to the mapper: the whole map, renders, images and poses of keyframes, the state to be saved."""

from __future__ import annotations

from collections.abc import Iterator

from beamsplat.common.errors import UserError
from beamsplat.common.messages import Image, MapChunk, MapPoses, MapRender, MapState
from beamsplat.services.mapping.chunks import chunk_snapshot
from beamsplat.services.mapping.intake import KeyframeIntake
from beamsplat.services.mapping.mapper import FULL, Mapper
from beamsplat.services.mapping.messages import (
    chunk_message,
    image_message,
    keyframe_rgb,
    poses_message,
    render_message,
    state_messages,
)
from beamsplat.services.mapping.preview import render_view
from beamsplat.services.mapping.queries import check_names, keyframe_id_of, view_of, viewpoint_of
from beamsplat.services.mapping.session.live_session import MapSession
from beamsplat.services.mapping.session.state import arrays_of


class MapQueries:
    """The handlers of queries of `node.MappingNode`, which sets the attributes."""

    _mapper: Mapper
    _intake: KeyframeIntake
    _session: MapSession

    def on_query_snapshot(self, parameters: dict[str, str]) -> Iterator[MapChunk]:
        """Yield the whole map, chunk by chunk, for a viewer that has just joined.

        With the parameters `from=X,Y,Z` (m, map frame), `focal_px` and `error_px`, detail that is invisible
        from this viewpoint is omitted.
        """
        viewpoint = viewpoint_of(parameters)
        self._check_map("snapshot")
        for anchor, part in chunk_snapshot(self._mapper, viewpoint):
            yield chunk_message(self._mapper, anchor, part, 0)

    def on_query_render(self, parameters: dict[str, str]) -> Iterator[MapRender]:
        """Yield the map as a camera would see it.

        Parameters: `position=X,Y,Z` (m) and `quaternion=X,Y,Z,W` of the optical frame in the map frame;
        `width_px`, `height_px` and `focal_px` for another camera than that of the keyframes at half size.
        """
        T_map_camera, camera = view_of(parameters)
        self._check_map("render")
        yield render_message(render_view(self._mapper, T_map_camera, camera), T_map_camera)

    def on_query_poses(self, parameters: dict[str, str]) -> Iterator[MapPoses]:
        """Yield the refined poses of all keyframes, as `mapping/poses` has them at the end of a drive."""
        check_names("poses", parameters, ())
        self._check_map("poses")
        yield poses_message(self._intake.poses())

    def on_query_keyframe(self, parameters: dict[str, str]) -> Iterator[Image]:
        """Yield the undistorted image of the keyframe `id` as a JPEG, from memory or from the session."""
        self._check_map("keyframe")
        id = keyframe_id_of(parameters)
        keyframe = self._mapper.keyframes.get(id)
        if keyframe is not None:
            yield image_message(keyframe.levels[FULL].rgb.transpose(1, 2, 0))
        elif id in self._mapper.paged_out and (message := self._session.read(id)) is not None:
            yield image_message(keyframe_rgb(message, self._intake.undistorter))
        else:
            raise UserError(f"keyframe: id={id}: the image of this keyframe is not kept")

    def on_query_state(self, parameters: dict[str, str]) -> Iterator[MapState]:
        """Yield the current state of the map, with the content of a checkpoint, in several messages."""
        check_names("state", parameters, ())
        self._check_map("state")
        yield from state_messages(self._session.complete(arrays_of(self._mapper, self._intake.arrays())))

    def _check_map(self, query: str) -> None:
        if not self._intake.stored():
            raise UserError(f"{query}: the map is still empty")
