"""A mapper in a process of its own that is driven round and round through the home; what it takes is measured
there.
"""

import gc
import multiprocessing
import time
from dataclasses import dataclass

import numpy as np
import psutil

from tests.services.mapping.session.maps import SECOND, handle


@dataclass(frozen=True)
class Lap:
    """The keyframes of one lap, as `Keyframe` fields, and the scenes's lens."""

    model: object
    parts: list  # (jpeg, depth png, sigma png, T_map_body) each
    anchor_every: int  # keyframes between two submaps

    def message(self, number, period_s):
        """Keyframe `number` of a drive of many laps. Anchors are those of the first lap: the place is known."""
        from beamsplat.common.geometry.transforms import inverse
        from beamsplat.common.messages import Keyframe

        here = number % len(self.parts)
        jpeg, depth, sigma, T_map_body = self.parts[here]
        anchor = here // self.anchor_every
        T_map_anchor = self.parts[anchor * self.anchor_every][3]
        stamp_ns = 1_000_000_000_000 + round(number * period_s * SECOND)
        return Keyframe(stamp_ns=stamp_ns, id=stamp_ns, encoding="jpeg", picture=jpeg, camera=self.model,
                        anchor_id=anchor, T_anchor_body=inverse(T_map_anchor) @ T_map_body, T_map_anchor=T_map_anchor,
                        depth=depth, sigma=sigma)  # fmt: skip


def lap_of(home, anchor_every):
    """The home's drive, all pictures taken."""
    parts = [(*home.shot(n), home.T_map_body(n)) for n in range(home.keyframes_a_lap)]
    return Lap(home.model, parts, anchor_every)


@dataclass(frozen=True)
class Sample:
    """How the process does after so many keyframes."""

    keyframes: int
    pss_mb: float  # its share of what others map too is larger when those have ended
    private_mb: float  # its own alone: what grows shows here
    accounted_mb: float  # by the pager
    ms_a_keyframe: float  # of CPU, since the sample before
    gaussians: int
    on_disk: int  # of them
    detail: str
    renders: list  # float32 [3, H, W] of the views asked for, as they look now
    disk_mb: float


def drive(lap, folder, options, keyframes, sample_every, period_s, views, camera, said):
    """Runs in the child. `views` are numbers of the lap that are rendered at each sample."""
    from tests.services.mapping.session.maps import make_node

    process = psutil.Process()
    node = make_node(folder, **options)
    said.send(process.memory_full_info().pss / 1e6)
    spent = 0.0
    for number in range(keyframes):
        message = lap.message(number, period_s)
        before = time.thread_time()
        handle(node, "keyframes/frame", message, {})
        spent += time.thread_time() - before
        if (number + 1) % sample_every == 0:
            renders = [render(node, lap.message(view, period_s), camera) for view in views]
            gc.collect()
            store, pager = node._mapper.store, node._session._checkpointer._pager
            disk = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
            memory = process.memory_full_info()
            said.send(Sample(
                number + 1, memory.pss / 1e6, memory.uss / 1e6, pager._used(node._mapper) / 1e6,
                1e3 * spent / sample_every, store.count + store.paged_out_count, store.paged_out_count, node.detail, renders,
                disk / 1e6,
            ))  # fmt: skip
            spent = 0.0
    said.close()
    node.close()


def render(node, message, camera):
    """float32 [3, H, W]: what the mapper shows from a keyframe's place, all that it sees brought back first."""
    from beamsplat.services.mapping.keyframe import compress
    from beamsplat.services.mapping.messages import decode_keyframe
    from tests.services.mapping.home_drive import rendered

    frame = decode_keyframe(message, node._intake.undistorter)
    held = compress(frame, 0.03)
    node._session._checkpointer.load_visible(node._mapper, held)
    return rendered(node._mapper, camera, node._mapper.T_map_camera(held)).astype(np.float16)


def samples(*arguments):
    """(PSS in MB before the first keyframe, then a Sample each) as the child sends them."""
    context = multiprocessing.get_context("spawn")
    hear, said = context.Pipe(duplex=False)
    child = context.Process(target=drive, args=(*arguments, said))
    child.start()
    said.close()
    try:
        while True:
            yield hear.recv()
    except EOFError:
        pass
    finally:
        child.join()
    assert child.exitcode == 0
