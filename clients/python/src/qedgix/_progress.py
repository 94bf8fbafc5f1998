"""The progress bar of a job."""

from __future__ import annotations

from types import TracebackType
from typing import Any

from .results import JobEvent


class Bar:
    """A bar of tqdm; nothing if it is not enabled or tqdm is not installed."""

    def __init__(self, title: str, steps: int, *, enabled: bool) -> None:
        self._bar: Any = None
        if enabled:
            try:
                from tqdm.auto import tqdm
            except ImportError:
                return
            self._bar = tqdm(total=steps, desc=title, unit=" steps", unit_scale=True)

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

    def __enter__(self) -> Bar:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.close()
