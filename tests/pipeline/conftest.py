"""`bikeped run` as a process."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from small_crossing import Service


@pytest.fixture
def start() -> Iterator[Callable[..., Service]]:
    """Starts a service, which is killed after the test."""
    services: list[Service] = []

    def begin(*arguments: object, **options: object) -> Service:
        services.append(Service(*arguments, **options))  # type: ignore[arg-type]
        return services[-1]

    yield begin
    for service in services:
        service.close()
