"""Writes a small session of the present format, once, when its version is released."""

import json

import cv2

from services.mapping.session.folder import VERSION
from tests.services.mapping.session.maps import make_node, message
from tests.services.mapping.session.test_session import GOLDEN


def small(number):
    """A keyframe of few bytes: a quarter of the size."""
    whole = message(number)
    size = (40, 30)

    def shrunk(png):
        image = cv2.imdecode(png, cv2.IMREAD_UNCHANGED)
        return cv2.imencode(".png", cv2.resize(image, size, interpolation=cv2.INTER_NEAREST))[1].ravel()

    camera = whole.camera.model_copy(
        update={"width_px": 40, "height_px": 30, "fx_px": 27.5, "fy_px": 27.5, "cx_px": 19.5, "cy_px": 14.5}
    )
    fields = {name: shrunk(getattr(whole, name)) for name in ("picture", "depth_png", "sigma_png")}
    return whole.model_copy(update={**fields, "camera": camera, "beams": whole.beams[:0]})


if __name__ == "__main__":
    folder = GOLDEN / f"session-{VERSION}"
    if not folder.exists():
        node = make_node(folder)
        for number in range(2):
            list(node.handle("keyframes/frame", small(number)))
        list(node.drain())
        node.close()
        (folder / "edge" / "lock").unlink()
        store = node._mapper.store
        facts = {"keyframes": 2, "gaussians": store.count, "first_gaussian": store.params[:, 0].tolist()}
        (GOLDEN / f"session-{VERSION}.json").write_text(json.dumps(facts, indent=1) + "\n")
        print(folder)
