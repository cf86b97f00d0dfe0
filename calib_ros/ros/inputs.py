# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The node's subscriptions, and their health.

Messages wait serialised in the queues of their subscriptions until they are taken in batches. No
executor may serve these subscriptions, nor wait for their events (such as lost messages): Fast DDS
wakes it for these as long as any message waits, so it would never rest.
"""

from __future__ import annotations

import importlib
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter
from types import SimpleNamespace
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.time_source import CLOCK_TOPIC
from rclpy.waitable import Waitable

from calib_ros.errors import ConfigError
from calib_ros.sampling.batches import BATCH
from calib_ros.sampling.messages import CAMERA_INFO, PICTURES, short_type
from calib_ros.sampling.slices import NO_ACCIDENT, SILENCE
from calib_ros.sampling.streams import Stream, links_of
from calib_ros.settings import EXCEPTION

RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
TRANSIENT_LOCAL, VOLATILE = DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE
QUEUE, IMAGE_QUEUE = 5 * BATCH // 2, BATCH // 100
"""Messages and images of a topic that may wait while the node is busy: for seconds, on a busy
machine. From a deeper queue Fast DDS drops the newest messages beyond 5,000, and reports none."""
DUE = SimpleNamespace(add_event=lambda event: 0, is_ready=lambda kind, number: True)
"""The wait set of one polled event, which is looked at."""


@dataclass
class TopicState:
    """State of one topic; times [s] are monotonic."""

    count: int = 0
    before: int = 0
    rate: float = 0.0
    last: float | None = None
    continuous: bool = False  # true once two came in quick succession, not one for each stop
    latched: bool = False  # true if it is published only once
    lost: int = 0  # messages lost in transit, by DDS
    reported: int = 0  # the last total reported by DDS
    full: int = 0  # how often the queue was full, and messages were lost
    number: int = 0  # of the last message, as its publisher counts them
    lost_before: int = 0
    losing: bool = False  # true if either grew between the last two looks

    def note_lost(self, total: int) -> None:
        """Count up to a total of lost messages; its change omits some.

        DDS counts in signed 32 bits, and sometimes reports nonsense: a total that falls, or grows
        implausibly, is taken as the new start.
        """
        more = (total - self.reported) % 2**32
        self.reported = total
        if more < 2**30:  # two weeks of 1 kHz
            self.lost += more

    def note_queue(self, numbers: Sequence[int | None], depth: int) -> None:
        """Count messages from a queue, and whether it lost those before them, or any beyond.

        A full queue that lost none shows the next number; without numbers, or of publishers that
        count by turns, it is taken to have lost some.
        """
        if not numbers:
            return
        self.count += len(numbers)
        lost = numbers[0] != self.number + 1
        self.full += len(numbers) >= QUEUE or (lost and len(numbers) >= depth)
        self.number = numbers[-1] or 0

    def look(self, now: float, span: float) -> None:
        """Note how many messages arrived in the last `span`."""
        fresh, self.before = self.count - self.before, self.count
        self.rate = fresh / span
        lost, before = self.lost + self.full, self.lost_before
        self.losing, self.lost_before = lost > before, lost
        if fresh:
            quick = self.last is not None and now - self.last < 0.5 * SILENCE
            self.continuous, self.last = self.continuous or quick, now

    @property
    def share_lost(self) -> float:
        """Return the share lost in transit if it is large, and as long as more is lost."""
        share = self.lost / max(self.lost + self.count, 1)
        return share if self.losing and share > EXCEPTION and self.lost >= NO_ACCIDENT else 0.0

    @property
    def silent(self) -> bool:
        """Tell whether it has become silent."""
        if self.last is None or self.latched or not self.continuous:
            return False
        return time.monotonic() - self.last > SILENCE


class Inputs:
    """Subscriptions to streams of messages, emptied by hand."""

    def __init__(self, node: Batched, streams: Sequence[Stream]) -> None:
        self._node = node
        self._topics: dict[str, TopicState] = {}
        self._looked_at = time.monotonic()
        self.failures: list[str] = []
        """Why topics give nothing, as text, at the last look."""
        self._inputs = dict(self._subscribe(stream) for stream in streams)
        self._not_latched = [stream for stream in streams if stream.type == CAMERA_INFO]
        self._events = dict.fromkeys((e for each in self._inputs for e in each.event_handlers), 0)

    def take(self) -> list[tuple[Stream, bytes]]:
        """Return the messages since the last call, in order of arrival."""
        come = []
        for subscription, (stream, hearing) in self._inputs.items():
            found = _waiting(subscription)
            numbers = [info['publication_sequence_number'] for info, _ in found]
            hearing.note_queue(numbers, subscription.qos_profile.depth)
            come += [(info['received_timestamp'], stream, data) for info, data in found]
        come.sort(key=itemgetter(0))
        return [(stream, data) for _, stream, data in come]

    @property
    def topics(self) -> list[str]:
        """Return the topics that have received something."""
        return [topic for topic, hearing in self._topics.items() if hearing.count]

    def look(self) -> None:
        """Note losses, silence, rates and failures since the last look."""
        self._subscribe_to_latched()
        for event, known in self._events.items():
            event.add_to_wait_set(DUE)
            event.is_ready(DUE)
            status = event.take_data()
            if status is not None and status.total_count != known:
                self._events[event] = status.total_count
                event.callback(status)
        now = time.monotonic()
        span, self._looked_at = now - self._looked_at, now
        for hearing in self._topics.values():
            hearing.look(now, span)
        topics = self._topics.items()
        self.failures = [f'no more messages on {topic}' for topic, each in topics if each.silent]
        gone = [(topic, 100.0 * each.share_lost) for topic, each in topics if each.share_lost]
        self.failures += [f'{share:.0f} % of {topic} is lost on the way' for topic, share in gone]
        self.failures += self._unheard()
        streams = [stream for stream, _ in self._inputs.values()]
        self.failures += [words for links in links_of(streams) for words in links.problems()]

    def troubles(self) -> list[str]:
        """Return problems of topics as text."""
        topics = self._topics.items()
        losing = ', '.join(topic for topic, each in topics if each.losing and not each.share_lost)
        return [*self.failures, *([f'messages are lost on {losing}'] if losing else [])]

    def figures(self) -> dict[str, Any]:
        """Return the diagnostics of each topic."""
        now = time.monotonic()
        found: dict[str, Any] = {}
        for topic, each in self._topics.items():
            if each.last is not None:
                found[f'rate of {topic} [Hz]'] = f'{each.rate:.1f}'
                found[f'age of {topic} [s]'] = f'{now - each.last:.1f}'
                found[f'lost on {topic}'] = each.lost
                found[f'queue of {topic} full'] = each.full
        return found

    def _subscribe(self, stream: Stream) -> tuple[Subscription, tuple[Stream, TopicState]]:
        policies = QoSPolicyKind.RELIABILITY, QoSPolicyKind.DEPTH, QoSPolicyKind.HISTORY

        def checked(profile: QoSProfile) -> SetParametersResult:
            if profile.depth < 1:
                raise ConfigError(f'the depth of qos_overrides for "{stream.topic}" must be >= 1')
            return SetParametersResult(successful=True)

        try:
            name = self._node.resolve_topic_name(stream.topic)
        except rclpy_implementation.RCLError as err:
            why = str(err).partition(', at /')[0]
            raise ConfigError(f'"{stream.topic}" is no topic name: {why}') from err
        if name in self._topics and stream.type != CAMERA_INFO:  # it may be of several boards
            raise ConfigError(
                f'"{stream.topic}" is {name}, from which another input is taken: give each one '
                'its own topic, and name it once'
            )
        hearing = self._topics.setdefault(name, TopicState())
        hearing.latched = stream.still
        try:
            subscription = self._created(
                stream,
                stream.still,
                lambda event: hearing.note_lost(event.total_count),
                qos_overriding_options=QoSOverridingOptions(policies, callback=checked),
            )
        except RuntimeError as err:  # unknown policy
            raise ConfigError(f'invalid qos_overrides for "{stream.topic}": {err}') from err
        return subscription, (stream, hearing)

    def _subscribe_to_latched(self) -> None:
        """Subscribe to each CameraInfo that is latched: it may have been published long ago.

        That subscription hears no others, and their publishers would log warnings about it.
        """
        for stream in tuple(self._not_latched):
            topic = self._node.resolve_topic_name(stream.topic)
            infos = self._node.get_publishers_info_by_topic(topic)
            if TRANSIENT_LOCAL in (i.qos_profile.durability for i in infos):
                self._not_latched.remove(stream)
                subscription = self._created(stream, latched=True)
                self._inputs[subscription] = stream, TopicState()  # the other one counts

    def _created(
        self, stream: Stream, latched: bool, lost: Callable[..., None] | None = None, **more: Any
    ) -> Subscription:
        """Subscribe without an executor and without warnings, as `_unheard` reports."""
        return self._node.create_subscription(
            _message_type(stream.type),
            stream.topic,
            lambda data: None,
            QoSProfile(  # a new one each time, because overriding changes it
                depth=IMAGE_QUEUE if stream.type in PICTURES else QUEUE,
                reliability=RELIABLE if latched else BEST_EFFORT,
                durability=TRANSIENT_LOCAL if latched else VOLATILE,
            ),
            event_callbacks=SubscriptionEventCallbacks(
                message_lost=lost, use_default_callbacks=False
            ),
            raw=True,
            callback_group=self._node.polled,
            **more,
        )

    def _unheard(self) -> list[str]:
        """Return why publishers are not heard, by topic, even if others on it are."""
        found = set()
        for subscription, (stream, hearing) in self._inputs.items():
            topic, asked = subscription.topic_name, subscription.qos_profile
            if hearing is not self._topics[topic]:  # the second one, for latched messages
                continue
            for info in self._node.get_publishers_info_by_topic(topic):
                offered, how = info.qos_profile, ''
                if info.topic_type != stream.type:
                    how = f'as {info.topic_type}, not as {short_type(stream.type)}'
                    how += ': set type in sources' if stream.source else ''
                elif (asked.reliability, offered.reliability) == (RELIABLE, BEST_EFFORT):
                    how = 'best effort, but heard as reliable: set qos_overrides to best_effort'
                elif (asked.durability, offered.durability) == (TRANSIENT_LOCAL, VOLATILE):
                    how = 'not latched, but that is asked for: make it transient local'
                if how:
                    found.add(f'{topic} is published {how}')
        return sorted(found)


class Batched(Node):  # type: ignore[misc]  # see pyproject.toml
    """A node that hides `polled` entities from executors; not all ask a callback group.

    At 1 kHz /clock alone takes an executor a third of a core: `take_time` takes it.
    """

    def __init__(self, *args: Any, **more: Any) -> None:
        self.polled = ReentrantCallbackGroup()
        super().__init__(*args, **more)

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """Return the subscriptions that an executor serves."""
        return filter(self._served, super().subscriptions)

    @property
    def waitables(self) -> Iterator[Waitable]:
        """Return the waitables that an executor serves."""
        return filter(self._served, super().waitables)

    @property
    def services(self) -> Iterator[Service]:
        """Return the services that an executor serves."""
        return filter(self._served, super().services)

    def _served(self, entity: Any) -> bool:
        return entity.callback_group is not self.polled

    def create_subscription(self, kind: Any, topic: str, *args: Any, **more: Any) -> Subscription:
        """Subscribe; the time is polled."""
        own = {'callback_group': self.polled} if topic == CLOCK_TOPIC else {}
        return super().create_subscription(kind, topic, *args, **more | own)

    def take_time(self) -> None:
        """Take the last time on /clock; an invalid one must not end the node."""
        for times in super().subscriptions:
            for _, message in _waiting(times)[-1:] if times.topic == CLOCK_TOPIC else ():
                if message.clock.sec >= 0:
                    times.callback(message)
                    continue
                words = f'negative times on {CLOCK_TOPIC} are ignored ({message.clock.sec} s)'
                self.get_logger().warning(words, once=True)


def deserialised(data: bytes, name: str) -> Any:
    """Return a message from its bytes."""
    return deserialize_message(data, _message_type(name))


def _waiting(subscription: Subscription) -> list[tuple[dict[str, Any], Any]]:
    """Return the messages that wait, each with what the middleware tells of it."""
    found = []
    with subscription.handle:
        for _ in range(QUEUE):
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                break
            found.append((taken[1], taken[0]))
    return found


def _message_type(name: str) -> Any:
    package, _, kind = name.partition('/msg/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), kind)
    except ImportError as err:
        distribution = os.environ.get('ROS_DISTRO', 'jazzy')
        name = f'ros-{distribution}-{package.replace("_", "-")}'
        raise ConfigError(f'{package} cannot be imported, install {name}: {err}') from err
