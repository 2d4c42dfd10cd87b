"""View of an area without its stale stages."""

from __future__ import annotations

from spn_data.area.area import Area


class FreshStages(Area):
    """An area whose stale stages are as if they were not there."""

    def __init__(self, area: Area):
        self._fresh = {stage for stage in area.stages() if area.stale_because(stage) is None}
        super().__init__(area.root)

    def has(self, stage: str) -> bool:
        """Return whether a stage is complete and not stale."""
        return stage in self._fresh

    def sequences(self, group: str) -> tuple[str, ...]:
        """Return the names of the stages of a group that are not stale."""
        return tuple(n for n in super().sequences(group) if self.has(f"{group}/{n}"))
