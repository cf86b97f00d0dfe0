# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Calls of services, answered in the order in which they came."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from functools import partial
from operator import itemgetter
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.service import Service
from rclpy.waitable import NumberOfEntities, Waitable


class InOrder(Waitable):  # type: ignore[misc]  # see pyproject.toml
    """The services of a node, answered in the order of the calls.

    Jazzy's executors answer the calls that wait in the order in which the services were created:
    a ~/clear overtook the ~/identify before it.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(node.default_callback_group)
        self._logger = node.get_logger()
        self._services: list[Service] = [*node.services]
        for each in self._services:
            each.callback_group = node.polled  # no executor serves it
        self._places: list[int] = []  # in the wait set
        self._waited = ExitStack()
        node.add_waitable(self)

    def __enter__(self) -> None:
        """Keep services from being destroyed while they are waited for; forget those that were."""
        for each in tuple(self._services):
            try:
                self._waited.enter_context(each.handle)
            except InvalidHandle:
                self._services.remove(each)

    def __exit__(self, *error: object) -> None:
        """Let services be destroyed."""
        self._waited.close()

    def get_num_entities(self) -> NumberOfEntities:
        """Return what it adds to a wait set."""
        return NumberOfEntities(num_services=len(self._services))

    def add_to_wait_set(self, wait_set: Any) -> None:
        """Wait for calls."""
        self._places = [wait_set.add_service(each.handle) for each in self._services]

    def is_ready(self, wait_set: Any) -> bool:
        """Tell whether calls wait."""
        return any(wait_set.is_ready('service', place) for place in self._places)

    def take_data(self) -> list[tuple[int, Service, Any, Any]]:
        """Return the calls that wait, in the order in which they came."""
        come = []
        for service in self._services:
            with suppress(InvalidHandle), service.handle:
                take = partial(service.handle.service_take_request, service.srv_type.Request)
                for request, header in iter(take, (None, None)):
                    stamp = header.received_timestamp or header.source_timestamp  # 0: unknown
                    come.append((stamp, service, request, header))
        return sorted(come, key=itemgetter(0))

    async def execute(self, taken_data: list[tuple[int, Service, Any, Any]]) -> None:
        """Answer calls; the answer of one that fails is blank.

        To be answered later, a callback returns a function that takes how to send the answer.
        """
        for _, service, request, header in taken_data:
            send = partial(service.send_response, header=header)
            answer = service.srv_type.Response()
            try:
                try:
                    answer = service.callback(request, answer)
                finally:
                    answer(send) if callable(answer) else send(answer)
            except Exception as err:  # as of rclpy, for a parameter of no known type
                name = service.srv_name
                self._logger.error(f'{name}: the call cannot be answered: {err!r}')
