"""Solver settings."""

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Solver:
    """Solver settings, with ``auto`` resolved."""

    method: str
    integrator: str
    substeps: int
    iterations: int
    precision: str = 'float64'
    threads: int = 1
    reason: str = ''
    """reason of the choice by ``auto``; empty without ``auto``"""
    rough_frames: int | None = None
    """calm frames of ``line`` after an unstable one of ``explicit``; None without ``explicit``"""
    rough_integrator: str | None = None
    """of these frames"""
    rough_substeps: int | None = None
    """of these frames"""

    @property
    def mixes(self) -> bool:
        """True if calm frames take ``explicit`` and rough ones ``line``, with hysteresis."""
        return bool(self.rough_frames)

    @property
    def with_history(self) -> str:
        """Integrator of the frames that are not ``explicit``."""
        explicit = self.method == 'explicit'
        return self.rough_integrator or 'leapfrog' if explicit else self.integrator

    @property
    def lengths(self) -> tuple:
        """All that a history's steps depend on."""
        return self.method, self.substeps, self.rough_substeps, self.with_history

    @property
    def rough(self) -> 'Solver':
        """Setting of the frames where ``explicit`` is unstable."""
        assert self.rough_integrator is not None and self.rough_substeps is not None
        return replace(self, method='line', integrator=self.rough_integrator,
                       substeps=self.rough_substeps)
