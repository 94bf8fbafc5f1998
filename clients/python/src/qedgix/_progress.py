"""Progress bars, if tqdm is installed."""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING, Any

from .results import JobEvent

if TYPE_CHECKING:
    from typing_extensions import Self


class _Bar:
    """A bar of tqdm; nothing if it is not enabled or tqdm is not installed."""

    def __init__(self, *, enabled: bool, **options: Any) -> None:
        self._bar: Any = None
        if enabled:
            try:
                from tqdm.auto import tqdm
            except ImportError:
                return
            self._bar = tqdm(unit_scale=True, **options)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.close()


class JobBar(_Bar):
    """The steps of a job."""

    def __init__(self, title: str, steps: int, *, enabled: bool) -> None:
        super().__init__(enabled=enabled, total=steps, desc=title, unit=" steps")

    def show(self, event: JobEvent) -> None:
        """Shows the newest step and the newest mean AoI."""
        if self._bar is None:
            return
        if event.state is not None:
            self._bar.set_postfix_str(event.state)
        for metric in event.metrics:
            self._bar.update(max(0, min(metric.step, self._bar.total) - self._bar.n))
            if metric.name == "eval/mean_aoi":
                self._bar.set_postfix_str(f"validation mean AoI {metric.value:.2f}")


class UploadBar(_Bar):
    """The bytes of an upload."""

    def __init__(self, title: str, size: int, *, enabled: bool) -> None:
        super().__init__(enabled=enabled, total=size, desc=title, unit="B", unit_divisor=1024)

    def restart(self) -> None:
        """Nothing has been sent in this attempt."""
        if self._bar is not None:
            self._bar.reset()

    def add(self, size: int) -> None:
        """So many more bytes are sent."""
        if self._bar is not None:
            self._bar.update(size)
