"""Main functions of the processes of a running system: one node on the bus, or the router."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing import connection, parent_process
from pathlib import Path

from beamsplat.common.config.deployment import Deployment
from beamsplat.common.errors import UserError, reason
from beamsplat.common.files.epochs import EpochClaims
from beamsplat.common.messages.instances import ProcessId
from beamsplat.common.optional_packages import missing_packages_explained
from beamsplat.common.redaction import without_secrets
from beamsplat.common.runtime.live import Live, LiveSettings
from beamsplat.common.runtime.registry import Service
from beamsplat.common.security.access_control import read_hosts
from beamsplat.common.security.keys import CERTIFICATE, HOSTS
from beamsplat.common.zenoh.bus import open_router
from beamsplat.services.nodes import NODES
from beamsplat.tools.system.assembly import Surroundings, build_node, node_classes, surroundings
from beamsplat.tools.system.log_tail import rotated
from beamsplat.tools.system.process_title import set_process_title

log = logging.getLogger("beamsplat")

STOP_S = 5.0  # from SIGTERM to SIGKILL
LOG_BYTES = 10_000_000  # at this size a log becomes the older part, which replaces the one before
LOG_CHECK_S = 2.0

# Two cores are shared by all services: no library may start a thread per core. Read by OpenMP, BLAS and
# numba when they are first imported, by glibc when a program starts, hence set before the fork server starts.
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
# glibc's pools of memory for threads: by default eight per core, each with memory that was freed and not
# returned. A node has about 30 threads, most of which receive the messages of one topic.
FEW_ARENAS = {"MALLOC_ARENA_MAX": "2"}
# Where Numba looks for compiled kernels, in this order: also on a disk that is full or read-only.
_KERNEL_CACHES = (
    "beamsplat.common.kernel_cache.ReadableCacheLocator", "UserWideCacheLocator",
    "beamsplat.common.kernel_cache.UnwritableCacheLocator",
)  # fmt: skip
CHILD_ENVIRONMENT = {**ONE_THREAD, **FEW_ARENAS, "NUMBA_CACHE_LOCATOR_CLASSES": ",".join(_KERNEL_CACHES)}


def serve(
    deployment: Deployment,
    name: str,
    *,
    resume: bool = False,
    exit_when_drained: bool = False,
    around: Surroundings | None = None,
    identity: ProcessId,
    standby: bool = False,
    table: dict[str, Service] = NODES,
) -> None:
    """Run one node until its inputs end, or SIGINT or SIGTERM arrives.

    Args:
        resume: start from the last checkpoint, after a crash.
        exit_when_drained: end the process when the node has processed its last input.
        around: facts about the other nodes; None: computed here, which imports the classes of all nodes.
        identity: of this process on the bus, claimed by its supervisor.
        standby: start as the successor of a running node, see `beamsplat.tools.system.swap`.
        table: known services by name.

    Raises:
        UserError: an option is invalid, input data is not usable, or no router answers.
    """
    threading.excepthook = end_process
    if around is None:
        around = surroundings(node_classes(deployment, table), name, deployment.role)
    settings = replace(
        live_settings(deployment, around, identity, resume),
        exit_when_drained=exit_when_drained,
        standby=standby,
    )
    node = build_node(deployment, name, table)
    limit_threads(node.config.threads)
    os.nice(node.config.nice)
    live = Live(node, settings)
    live.install_signal_handlers()
    live.run()


def live_settings(
    deployment: Deployment, around: Surroundings, identity: ProcessId, resume: bool
) -> LiveSettings:  # fmt: skip
    """Return the settings of a node that runs with `identity`; for the arguments see `serve`."""
    return LiveSettings(
        robot=deployment.robot,
        endpoints=deployment.router.listen,
        run_dir=deployment.run_dir,
        security=deployment.security,
        rate=deployment.rate,
        wait_for=around.wait_for,
        without_producer=around.without_producer,
        resume=resume,
        epoch=identity.epoch,
        instance=identity.instance,
    )


def serve_alone(deployment: Deployment, name: str) -> None:
    """Run one node in this process, without a supervisor, until it has processed its last input.

    Raises:
        UserError: see `serve`.
    """
    identity = EpochClaims(deployment.run_dir, log.warning).claim(name)
    serve(deployment, name, exit_when_drained=True, identity=identity)


def route(deployment: Deployment) -> None:
    """Run this host's router until SIGINT or SIGTERM arrives.

    When the policy or the certificate changes, the router restarts; clients reconnect within a second.
    """
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    router, security = deployment.router, deployment.security
    keys = security.keys
    while not stop.is_set():
        policy = _changed_at(keys)
        with open_router(router.listen, router.connect, security):
            while not stop.wait(0.5):
                if keys is None or _changed_at(keys) == policy:
                    continue
                try:
                    read_hosts(keys)
                    break
                except UserError as error:  # being copied or edited: keep the old policy
                    policy = _changed_at(keys)
                    log.error("the new policy is not taken up: %s", error)


def _changed_at(keys: Path | None) -> int:
    """Return the modification time in ns of the newer of policy and certificate; 0 without both files."""
    if keys is None:
        return 0
    files = [keys.expanduser() / name for name in (HOSTS, CERTIFICATE)]
    return max((file.stat().st_mtime_ns for file in files if file.exists()), default=0)


def child(
    deployment: Deployment,
    name: str,
    log_file: Path,
    resume: bool,
    around: Surroundings | None,
    table: dict[str, Service],
    identity: ProcessId,
    standby: bool = False,
) -> None:
    """Run a node or the router as a supervised process: output is appended to a log file.

    The exit code is 2 after a UserError. For the arguments see `serve`.
    """

    def run() -> None:
        if name == "router":
            route(deployment)
            return
        serve(
            deployment, name, resume=resume, around=around, identity=identity, standby=standby, table=table
        )  # fmt: skip

    run_supervised(name, log_file, run)


def run_supervised(name: str, log_file: Path, run: Callable[[], None]) -> None:
    """Call `run` as the process `name` of a supervisor; see `child`."""
    # Ctrl-C in a terminal is sent to the whole process group; the supervisor stops processes in order.
    os.setpgrp()
    set_process_title(f"beamsplat:{name}")
    log_fault = _redirect_output(log_file)
    threading.Thread(target=_attend, args=(log_file,), name="parent", daemon=True).start()
    start_logging()
    if log_fault:
        log.warning("%s: %s; the log of %s goes to the output of the supervisor", log_file, log_fault, name)
    try:
        with missing_packages_explained(name):
            run()
    except UserError as error:
        log.error("%s", error)
        sys.exit(2)
    except Exception:  # logged here, because a log has no secrets
        log.critical("ended by an exception", exc_info=True)
        sys.exit(1)


def end_process(failure: threading.ExceptHookArgs) -> None:
    """Log the exception that has ended a thread, and end this process with exit code 1.

    A process that lacks a thread would stay active and never hear an input again. The node is not closed:
    its files are as after a crash, and the main thread may hold any lock.
    """
    if failure.exc_type is SystemExit or sys.is_finalizing():
        return
    name = failure.thread.name if failure.thread else "unknown"
    log.critical(
        "an exception has ended the thread %s, and so this process", name,
        exc_info=(failure.exc_type, failure.exc_value or failure.exc_type(), failure.exc_traceback),
    )  # fmt: skip
    logging.shutdown()
    os._exit(1)


def _redirect_output(log_file: Path) -> str:
    """Append standard output and error to a file; return why not: the disk is full or read-only."""
    try:
        log_file.parent.mkdir(parents=True, exist_ok=True)
        with log_file.open("ab", buffering=0) as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
    except OSError as error:
        return reason(error)
    return ""


class _Formatter(logging.Formatter):
    """Formatter that removes passwords in URLs, also from tracebacks."""

    def format(self, record: logging.LogRecord) -> str:
        return without_secrets(super().format(record))


def start_logging(level: int = logging.INFO) -> None:
    """Configure logging to standard error, with time, level and logger name in each line."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Formatter("%(asctime)s %(levelname)-7s %(name)s: %(message)s"))
    logging.basicConfig(level=level, handlers=[handler], force=True)


def _rotate(log_file: Path) -> None:
    """Begin a new log if this one is full, or if the predecessor of this process has begun one.

    Whatever writes to standard error, C libraries included, writes to the new file from then on.
    """
    try:
        mine = os.fstat(2)
        if not log_file.exists() or log_file.stat().st_ino != mine.st_ino:
            _redirect_output(log_file)
        elif mine.st_size > LOG_BYTES:
            log_file.replace(rotated(log_file))
            _redirect_output(log_file)
    except OSError:  # a disk that cannot be written now; tried again
        return


def _attend(log_file: Path) -> None:
    """Keep the log bounded, and stop this process when its supervisor ends: it must not run unsupervised."""
    parent = parent_process()
    if parent is not None:
        while not connection.wait([parent.sentinel], LOG_CHECK_S):
            _rotate(log_file)
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(STOP_S)
        os.kill(os.getpid(), signal.SIGKILL)


def limit_threads(threads: int) -> None:
    """Set the number of threads of OpenCV and PyTorch, if they are imported already."""
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(threads)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(threads)
