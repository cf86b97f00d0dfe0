# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags to a session."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from calib_ros.annotated import as_annotated
from calib_ros.decision.reasons import Reason, Rule
from calib_ros.errors import InputError, UnknownNameError, shortened
from calib_ros.files import stored
from calib_ros.files.cameras import cameras_of
from calib_ros.files.unpacked import unpacked_files
from calib_ros.progress import Notify, quiet
from calib_ros.sampling.account import ALLOW, Account, allowing, too_much_lost
from calib_ros.sampling.batches import Deserialise, batches, feed
from calib_ros.sampling.messages import BODIES, JOINT_STATE, PICTURES, head_of
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.streams import Stream, links_of
from calib_ros.sampling.topics import MessagesOn, Recorded, check_joints, choose_topics

if TYPE_CHECKING:
    from rosbags.interfaces import MessageDefinition

    Definitions: TypeAlias = Mapping[str, MessageDefinition]


@dataclass(frozen=True)
class Replayed:
    """Counts of messages read from a bag, and warnings."""

    recorded: int | None  # messages in the bag; None if unknown
    read: int  # messages decoded
    warnings: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.recorded is None:
            return f'read {self.read} messages of the bag; how many are lost is not known'
        return f'read {self.read} of {self.recorded} messages of the bag'

    def refusals(self, account: Account, largest_loss: float) -> tuple[Reason, ...]:
        """Return why a result must not be accepted: more was lost than `largest_loss`.

        Lost are messages that could not be read and, for joint states and measurements each, those
        dropped for their stamp or a full buffer; not what the device did not see.
        """
        if self.recorded is None and largest_loss < 1.0:
            text = f'how much of the bag is lost is not known: {ALLOW} 1'
            return (Reason(Rule.UNKNOWN_LOSS, text),)
        share = max(0.0, 1.0 - self.read / self.recorded) if self.recorded else 0.0
        text = f'{100.0 * share:.0f} % of the messages could not be read: {allowing(share)}'
        unreadable = [Reason(Rule.UNREADABLE, text)] if share > largest_loss else []
        return (*unreadable, *too_much_lost(account, largest_loss))


@as_annotated
def replay(path: Path | str, session: CalibrationSession, progress: Notify = quiet) -> Replayed:
    """Feed a bag to a session; return what could be read.

    The path is the folder of a rosbag2 recording, or one of its .mcap or .db3 files. The settings
    of the session name topics if the types are ambiguous; `progress` receives the share read.
    """
    path = Path(path)
    with unpacked_files(path) as folder:
        session.pictures.cameras = cameras_of(session.settings.sources)
        session.pictures.patient = True
        rosbag2()  # required even for damaged files
        try:
            reader = _opened(path, folder)
        except InputError:
            if (found := stored.salvage(folder)) is None:
                raise
            return _salvaged(path, found, session, {})
        with closing(reader):
            available = stored.topic_types((c.topic, c.msgtype) for c in reader.connections)
            defined = {c.msgtype: c.msgdef for c in reader.connections if c.msgdef.data}
            on = partial(stored.read, reader)
            streams, deserialise = _choose_streams(session, available, on, defined)
            counts = [c.msgcount for c in reader.connections if c.topic in streams]
            expected = sum(count for count in counts if isinstance(count, int) and count > 0)
            count, problem = _feed(session, on(streams), deserialise, progress, expected)
        if problem is not None and count == 0 and (found := stored.salvage(folder)) is not None:
            found.problem = found.problem or problem
            return _salvaged(path, found, session, defined)
    _check_links(streams)
    warnings = tuple(hint.text for hint in session.last_hints)
    if problem is not None:
        lost = f'{max(0, expected - count)} of {expected} messages are lost'
        warnings = (*warnings, f'{path} is damaged ({shortened(problem)}): {lost}')
    return Replayed(expected, count, warnings)


def _opened(path: Path, folder: Path) -> Any:
    library = rosbag2()
    try:
        stored.check_bag(folder)
        reader = library.Reader(folder)
        reader.open()
    except Exception as err:  # a damaged file fails in many ways, in the library and below it
        raise InputError(
            f'{path} is not a readable rosbag2 recording ({err}): give the folder of one, or copy '
            'it again from the computer that made it'
        ) from err
    return reader


def _salvaged(
    path: Path, found: stored.Salvage, session: CalibrationSession, known: Definitions
) -> Replayed:
    streams, deserialise = _choose_streams(session, found.topics, found.on, known)
    count, problem = _feed(session, found.on(streams), deserialise)
    _check_links(streams)
    problem = problem or found.problem
    total = stored.recorded(found.files[0].parent)
    if total is None and found.whole:
        total = found.count
    warnings = tuple(hint.text for hint in session.last_hints)
    if problem or total != found.count:
        lost = 'how many are lost is not known'
        if total is not None and not (total == found.count and problem == stored.NOT_CLOSED):
            lost = f'{max(0, total - found.count)} of {total} messages are lost'
        used = f'{count} messages could be read and are used, {lost}'
        why = shortened(problem or 'is a file of it missing?')
        warnings = (*warnings, f'{path} is damaged ({why}): {used}')
    return Replayed(total, found.count, warnings)


def pictures(path: Path, topic: str = '') -> Iterator[tuple[int, Any]]:
    """Yield the images of a bag on one topic, with their stamps [ns].

    sensor_msgs/Image and CompressedImage; one that cannot be decoded raises InputError.
    """
    deserialise = _deserialiser({})
    with unpacked_files(path) as folder, closing(_opened(path, folder)) as reader:
        found = {c.topic: c for c in reader.connections if c.msgtype in PICTURES}
        if topic and topic not in found:
            raise UnknownNameError(f'{path}: image topic', topic, found)
        if len(found) != 1 and not topic:
            names = ', '.join(found) or ' or '.join(PICTURES)
            problem = 'several topics of images, choose one with --topic' if found else 'no'
            raise InputError(f'{path} has {problem}: {names}')
        wanted = [found[topic]] if topic else list(found.values())
        for connection, _, data in reader.messages(wanted):
            try:
                message = deserialise(data, connection.msgtype)
            except Exception as err:  # a damaged message fails in many ways
                raise InputError(f'{path}: a damaged image on {connection.topic}') from err
            yield head_of(message)[0], message


def _choose_streams(
    session: CalibrationSession, topics: Mapping[str, str], on: MessagesOn, known: Definitions
) -> tuple[dict[str, Stream], Deserialise]:
    defined = {kind: each for kind, each in known.items() if kind in BODIES}
    recorded = Recorded(topics, on, _deserialiser(defined))
    streams = choose_topics(recorded, session.settings)
    for topic, stream in streams.items():
        if stream.type in BODIES and stream.type not in defined:
            raise InputError(
                f'the bag does not define {stream.type} of {topic}: record it on a computer with '
                'that package'
            )
    joints = {topic: stream for topic, stream in streams.items() if stream.type == JOINT_STATE}
    if len(joints) > 1 and not session.settings.joint_topics:
        check_joints(recorded, joints, session.joint_names)
    return streams, recorded.deserialise


def _check_links(streams: Mapping[str, Stream]) -> None:
    problems = [words for links in links_of(streams.values()) for words in links.problems()]
    if problems:
        raise InputError('; '.join(problems))


def rosbag2() -> Any:
    """Return the rosbags library; only bags need it."""
    try:
        from rosbags import rosbag2
    except ImportError as err:
        raise InputError(
            f'bags need the Python package rosbags, which is not installed ({err}): pip install '
            'rosbags, in a virtual environment if Python is managed by the system (README, '
            '"Bags"); tables (--csv) and the node work without it'
        ) from err
    return rosbag2


@cache
def typestore() -> Any:
    """Return the library's message types; loading takes a tenth of a second."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def _deserialiser(defined: Definitions) -> Deserialise:
    if not defined:
        return lambda data, kind: _decoded(typestore(), data, kind)
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    for kind, (form, text) in defined.items():
        idl = form == MessageDefinitionFormat.IDL
        try:
            if len(text) > stored.LARGEST_MESSAGE:
                raise ValueError(f'it has more than {stored.LARGEST_MESSAGE} characters')
            found = get_types_from_idl(text) if idl else get_types_from_msg(text, kind)
            store.register({k: each for k, each in found.items() if k not in store.fielddefs})
        except Exception as err:  # a damaged definition fails in many ways
            raise InputError(f'the definition of {kind} in the bag cannot be read: {err}') from err
    return partial(_decoded, store)


def _decoded(store: Any, data: bytes, kind: str) -> Any:
    """Return a message; rclpy may write up to 12 bytes behind it, the library accepts 3."""
    try:
        return store.deserialize_cdr(data, kind)
    except Exception:  # damaged bytes fail in many ways
        for behind in (4, 8, 12):
            with suppress(Exception):
                return store.deserialize_cdr(data[:-behind], kind)
        raise


def _feed(
    session: CalibrationSession,
    messages: Iterator[tuple[Stream, bytes]],
    deserialise: Deserialise,
    progress: Notify = quiet,
    expected: int = 0,
) -> tuple[int, str | None]:
    """Feed serialised messages and report their share; return their number, and any problem."""
    count, problem = 0, None
    for batch, err in batches(messages):
        if err is not None:
            problem = str(err) or type(err).__name__
        problems = feed(session, batch, deserialise)
        count += len(batch) - len(problems)
        problem = (problem, *problems)[-1]
        progress(count / max(expected, count, 1))
    session.finish()
    return count, problem
