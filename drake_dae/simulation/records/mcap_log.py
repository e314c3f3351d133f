"""Records as MCAP logs, which Foxglove shows, and logs of robots in MCAP."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from drake_dae.arrays import FloatArray, listed
from drake_dae.dae.system.signals import Signal
from drake_dae.errors import ModelError
from drake_dae.simulation.records.columns import (
    TIME,
    Recorded,
    Table,
    name_and_unit,
    recorded_groups,
)
from drake_dae.simulation.records.optional import optional_module

NANO = 1e-9
"""MCAP counts in ns."""


def write_mcap(
    path: str | Path,
    time: FloatArray,
    signals: Mapping[str, Recorded],
    about: Mapping[str, Any],
) -> None:
    """Writes a channel "/<signal>" of JSON messages {"<name>": number} for each signal.

    Args:
        path: The file.
        time: The times in s, shape (k,), not negative.
        signals: The signals by name.
        about: The metadata "drake_dae".

    Raises:
        ModelError: mcap is not installed, or a time is negative.
    """
    if time.size and time[0] < 0.0:
        raise ModelError(f"MCAP has no times before 0 s, and the record begins at {time[0]:g} s")
    writer = optional_module("mcap.writer", "a log in MCAP", "mcap").Writer(str(path))
    writer.start(library="drake_dae")
    writer.add_metadata("drake_dae", {"about": json.dumps(about)})
    for name, recorded in signals.items():
        properties = {
            s.name: {"type": ["number", "null"], "description": s.unit, "unit": s.unit}
            for s in recorded.signals
        }
        schema = json.dumps({"title": name, "type": "object", "properties": properties})
        number = writer.register_schema(f"drake_dae.{name}", "jsonschema", schema.encode())
        channel = writer.register_channel(f"/{name}", "json", number)
        stamps = [round(moment / NANO) for moment in time.tolist()]
        for count, (stamp, row) in enumerate(zip(stamps, recorded.values.tolist(), strict=True)):
            numbers = [value if np.isfinite(value) else None for value in row]
            text = json.dumps(dict(zip(properties, numbers, strict=True)))
            writer.add_message(channel, stamp, text.encode(), stamp, count)
    writer.finish()


def read_mcap(path: str | Path, columns: Mapping[str, str] | None) -> Table:
    """Reads what `write_mcap` writes, or the log of a robot in JSON or ROS 2's CDR.

    There is a row for each message of the first topic, at the time of its logging, as soon as all
    topics have a message. From another topic a row has the last message before.

    Args:
        path: The file.
        columns: "/topic.field" -> its name in a record, "<signal>.<name>", with or without a unit
            in brackets; fields of fields follow after a dot, entries of a list as in
            "/joint_states.position[0]". None for the names of `write_mcap`.

    Raises:
        ModelError: mcap is not installed, the file cannot be read, or it lacks a topic or a field.
    """
    factories = [_Json()]
    with suppress(ImportError):
        factories.append(import_module("mcap_ros2.decoder").DecoderFactory())
    reader = optional_module("mcap.reader", "a log in MCAP", "mcap")
    topics = None if columns is None else sorted({_topic(name) for name in columns})
    messages = dict[str, list[tuple[int, dict[str, float]]]]()
    units = dict[str, str]()
    try:
        with open(path, "rb") as file:
            log = reader.make_reader(file, decoder_factories=factories)
            for schema, channel, message, content in log.iter_decoded_messages(topics):
                fields = dict(_numbers(channel.topic, content))
                if channel.topic not in messages and schema is not None:
                    units |= _units(channel.topic, schema)
                messages.setdefault(channel.topic, []).append((message.log_time, fields))
    except Exception as error:  # mcap raises many kinds; no decoder for an encoding is one.
        text = getattr(error, "strerror", None) or error
        raise ModelError(f"{path} cannot be read as MCAP: {text}") from None
    available = [name for topic in messages.values() for name in topic[0][1]]
    if columns is None:
        columns = {name: name[1:] for name in available}
    if not columns:
        raise ModelError(f"{path} has no message with a number")
    missing = [name for name in columns if name not in available]
    if missing:
        raise ModelError(f"{path} has no {listed(missing)}; it has {listed(available, 30)}")
    return _table(path, messages, units, columns)


def _table(
    path: str | Path,
    messages: Mapping[str, Sequence[tuple[int, Mapping[str, float]]]],
    units: Mapping[str, str],
    columns: Mapping[str, str],
) -> Table:
    stamps = {topic: np.array([stamp for stamp, _ in log]) for topic, log in messages.items()}
    used = list(dict.fromkeys(_topic(name) for name in columns))
    ticks = np.unique(stamps[used[0]])
    ticks = ticks[ticks >= max(stamps[topic][0] for topic in used)]
    rows = {topic: np.searchsorted(stamps[topic], ticks, side="right") - 1 for topic in used}
    groups = dict[str, list[tuple[FloatArray, Signal]]]()
    for name, target in columns.items():
        target_name, unit = name_and_unit(target)
        group, dot, entry = target_name.partition(".")
        if not dot or group == TIME:
            raise ModelError(
                f"{path}: '{name}' must become '<signal>.<name>', such as 'control.joint1_motor', "
                f"got '{target}'; times are those of the messages"
            )
        topic = _topic(name)
        fields = [messages[topic][row][1] for row in rows[topic].tolist()]
        values = np.array([numbers.get(name, np.nan) for numbers in fields])
        groups.setdefault(group, []).append((values, Signal(entry, unit or units.get(name, ""))))
    return ticks * NANO, recorded_groups(groups)


class _Json:
    """A decoder factory of mcap, for JSON."""

    def decoder_for(self, message_encoding: str, schema: Any) -> Any:
        return json.loads if message_encoding == "json" else None


def _numbers(name: str, content: Any) -> Iterator[tuple[str, float]]:
    """The numbers in a message, each with the name of its field."""
    if isinstance(content, (bool, int, float)):
        yield name, float(content)
    elif isinstance(content, Mapping):
        for key, value in content.items():
            yield from _numbers(f"{name}.{key}", np.nan if value is None else value)
    elif hasattr(content, "__slots__"):  # Messages of ROS 2.
        for key in content.__slots__:
            yield from _numbers(f"{name}.{key}", getattr(content, key))
    elif isinstance(content, (Sequence, np.ndarray)) and not isinstance(content, (str, bytes)):
        for index, value in enumerate(content):
            yield from _numbers(f"{name}[{index}]", value)


def _units(topic: str, schema: Any) -> dict[str, str]:
    """Reads the units that `write_mcap` writes into a schema."""
    if schema.encoding != "jsonschema":
        return {}
    properties = json.loads(schema.data).get("properties", {})
    return {f"{topic}.{key}": str(field.get("unit", "")) for key, field in properties.items()}


def _topic(name: str) -> str:
    return name.partition(".")[0]
