"""Execution of the background jobs, inline or in a thread; the results are identical."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

from beamsplat.services.localization.lidar2d.jobs import BackgroundJob, JobResult
from beamsplat.services.localization.lidar2d.slam import LidarSlam, ScanResult


class JobRunner:
    """Runs the background jobs of a LidarSlam.

    Call `before_scan()` before and `after_scan()` after each `slam.add_scan()`. A result is applied exactly
    at the scan that its job names, so that the map does not depend on threading. If the thread is not
    finished by then, the runner blocks (counted in `waits`).
    """

    def __init__(self, slam: LidarSlam, threaded: bool = False) -> None:
        self.slam = slam
        self.waits = 0
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="lidar-slam") if threaded else None
        self._future: Future[JobResult] | None = None
        self._job: BackgroundJob | None = None

    def before_scan(self) -> None:
        """Apply the result of the running job if it is due before the next scan."""
        if self._job is None or self.slam.scans < self._job.apply_at_scan:
            return
        if self._future is not None:
            self.waits += not self._future.done()
            result = self._future.result()
        else:
            result = self._job.run()
        self._job, self._future = None, None
        self.slam.apply(result)

    def after_scan(self, result: ScanResult) -> None:
        """Start the background job in the result of `add_scan`, if the result contains one."""
        if result.job is not None:
            self._job = result.job
            self._future = self._pool.submit(result.job.run) if self._pool is not None else None

    def finish(self) -> None:
        """Wait for the running job and apply its result, then do the final optimisation."""
        if self._job is not None:
            result = self._future.result() if self._future is not None else self._job.run()
            self._job, self._future = None, None
            self.slam.apply(result)
        self.slam.finish()

    def __enter__(self) -> JobRunner:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
