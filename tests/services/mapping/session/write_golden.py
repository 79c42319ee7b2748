"""Write a small session of the current format; run once when a version is released."""

import json

import cv2

from beamsplat.common.mapfiles.session import EDGE_VERSION, VERSION
from beamsplat.common.messages.depth_codec import pack_depth, pack_sigma, unpack_depth, unpack_sigma
from beamsplat.services.mapping.session.disk_tier import groups_of
from tests.services.mapping.session.maps import make_node, message
from tests.services.mapping.session.test_session import GOLDEN


def small(number):
    """A keyframe of few bytes: a quarter of the size."""
    whole = message(number)
    size = (40, 30)

    def shrunk(image):
        return cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)

    camera = whole.camera.model_copy(
        update={"width_px": 40, "height_px": 30, "fx_px": 27.5, "fy_px": 27.5, "cx_px": 19.5, "cy_px": 14.5}
    )
    picture = shrunk(cv2.imdecode(whole.picture, cv2.IMREAD_UNCHANGED))
    fields = {
        "picture": cv2.imencode(".png", picture)[1].ravel(),
        "depth": pack_depth(shrunk(unpack_depth(whole.depth))),
        "sigma": pack_sigma(shrunk(unpack_sigma(whole.sigma))),
    }
    return whole.model_copy(update={**fields, "camera": camera, "beams": whole.beams[:0]})


def write(version, paged):
    """Two keyframes; `paged`: all Gaussians smaller than a cell are on disk."""
    folder = GOLDEN / f"session-{version}"
    if folder.exists():
        return
    node = make_node(folder, memory_mb=1000.0 if paged else None)
    for number in range(2):
        list(node.handle("keyframes/frame", small(number)))
    mapper = node._mapper
    first, count = mapper.store.params[:, 0].tolist(), mapper.store.count
    if paged:
        node._session._checkpointer.disk_tier.page_out(
            mapper.store, groups_of(mapper.store, mapper.T_map_anchor), mapper.T_map_anchor
        )
    list(node.drain())
    node.close()
    (folder / "edge" / "lock").unlink()
    facts = {"keyframes": 2, "gaussians": count, "first_gaussian": first}
    (GOLDEN / f"session-{version}.json").write_text(json.dumps(facts, indent=1) + "\n")
    print(folder)


if __name__ == "__main__":
    write(VERSION, False)
    write(EDGE_VERSION, True)
