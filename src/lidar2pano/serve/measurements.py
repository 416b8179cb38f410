"""What /metrics says, in Prometheus' text format."""

from __future__ import annotations

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest


class Measurements:
    """Counters of one server; each has a registry of its own."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self.requests = Counter(
            "lidar2pano_requests", "Requests for panoramas by HTTP status.", ["status"], registry=self._registry
        )
        self.waiting = Gauge(
            "lidar2pano_waiting", "Requests that are taken and not answered yet.", registry=self._registry
        )
        self.points = Counter("lidar2pano_points", "Points of translated scans.", registry=self._registry)
        self.stages = Histogram(
            "lidar2pano_stage_seconds", "Time of each stage of a panorama.", ["stage"], registry=self._registry
        )
        self.seconds = Histogram(
            "lidar2pano_request_seconds",
            "Time from a request to its answer.",
            buckets=(0.1, 0.25, 0.5, 1, 2.5, 5, 10, 25, 60, 120),
            registry=self._registry,
        )

    def text(self) -> bytes:
        """Everything, as Prometheus reads it."""
        return generate_latest(self._registry)
