"""A record as an MCAP log, as Foxglove shows it, and logs of robots in MCAP."""

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
from drake_dae.simulation.records.columns import TIME, Table, name_and_unit
from drake_dae.simulation.records.optional import optional_module

NANO = 1e-9
"""MCAP counts in ns."""


def write_mcap(
    path: str | Path,
    time: FloatArray,
    signals: Mapping[str, tuple[FloatArray, Sequence[Signal]]],
    about: Mapping[str, Any],
) -> None:
    """Writes a channel "/<signal>" of JSON messages {"<name>": number} for each signal.

    Args:
        path: The file.
        time: The times in s, shape (k,), not negative.
        signals: Name of a signal -> its values, shape (k, n), and their names and units.
        about: What is written as metadata "drake_dae".

    Raises:
        ModelError: mcap is not installed, or a time is negative.
    """
    if time.size and time[0] < 0.0:
        raise ModelError(f"MCAP has no times before 0 s, and the record begins at {time[0]:g} s")
    writer = optional_module("mcap.writer", "a log in MCAP", "mcap").Writer(str(path))
    writer.start(library="drake_dae")
    writer.add_metadata("drake_dae", {"about": json.dumps(about)})
    for name, (values, own) in signals.items():
        properties = {
            s.name: {"type": ["number", "null"], "description": s.unit, "unit": s.unit} for s in own
        }
        schema = json.dumps({"title": name, "type": "object", "properties": properties})
        number = writer.register_schema(f"drake_dae.{name}", "jsonschema", schema.encode())
        channel = writer.register_channel(f"/{name}", "json", number)
        names = [signal.name for signal in own]
        for count, (moment, row) in enumerate(zip(_ticks(time), values.tolist(), strict=True)):
            numbers = [value if np.isfinite(value) else None for value in row]
            text = json.dumps(dict(zip(names, numbers, strict=True)))
            writer.add_message(channel, moment, text.encode(), moment, count)
    writer.finish()


def read_mcap(path: str | Path, columns: Mapping[str, str] | None) -> Table:
    """Reads what `write_mcap` writes, or the log of a robot in JSON or ROS 2's CDR.

    The rows have the times at which messages of the first topic were logged, from the first one of
    them after which all topics are known; of others a row has the last message until then.

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
            known = reader.make_reader(file, decoder_factories=factories)
            for schema, channel, message, given in known.iter_decoded_messages(topics):
                fields = dict(_numbers(channel.topic, given))
                if channel.topic not in messages and schema is not None:
                    units |= _units(channel.topic, schema)
                messages.setdefault(channel.topic, []).append((message.log_time, fields))
    except Exception as error:  # mcap raises many kinds; no decoder for an encoding is one.
        text = getattr(error, "strerror", None) or error
        raise ModelError(f"{path} cannot be read as MCAP: {text}") from None
    if columns is None:
        columns = {name: name[1:] for own in messages.values() for name in own[0][1]}
    if not columns:
        raise ModelError(f"{path} has no message with a number")
    available = [name for own in messages.values() for name in own[0][1]]
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
    stamps = {topic: np.array([stamp for stamp, _ in own]) for topic, own in messages.items()}
    used = list(dict.fromkeys(_topic(name) for name in columns))
    ticks = np.unique(stamps[used[0]])
    ticks = ticks[ticks >= max(stamps[topic][0] for topic in used)]
    rows = {topic: np.searchsorted(stamps[topic], ticks, side="right") - 1 for topic in used}
    signals = dict[str, list[tuple[Signal, FloatArray]]]()
    for name, meant in columns.items():
        group, dot, entry = name_and_unit(meant)[0].partition(".")
        if not dot or group == TIME:
            raise ModelError(
                f"{path}: '{name}' must become '<signal>.<name>', such as 'control.joint1_motor', "
                f"got '{meant}'; times are those of the messages"
            )
        own = messages[_topic(name)]
        values = np.array([own[row][1].get(name, np.nan) for row in rows[_topic(name)].tolist()])
        one = Signal(entry, name_and_unit(meant)[1] or units.get(name, ""))
        signals.setdefault(group, []).append((one, values))
    return ticks * NANO, {
        group: (np.column_stack([v for _, v in own]), tuple(one for one, _ in own))
        for group, own in signals.items()
    }


class _Json:
    """What mcap calls a decoder factory, for JSON."""

    def decoder_for(self, message_encoding: str, schema: Any) -> Any:
        return json.loads if message_encoding == "json" else None


def _numbers(name: str, given: Any) -> Iterator[tuple[str, float]]:
    """The numbers of a message, with the places where they stand."""
    if isinstance(given, (bool, int, float)):
        yield name, float(given)
    elif isinstance(given, Mapping):
        for key, value in given.items():
            yield from _numbers(f"{name}.{key}", np.nan if value is None else value)
    elif hasattr(given, "__slots__"):  # Messages of ROS 2.
        for key in given.__slots__:
            yield from _numbers(f"{name}.{key}", getattr(given, key))
    elif isinstance(given, (Sequence, np.ndarray)) and not isinstance(given, (str, bytes)):
        for place, value in enumerate(given):
            yield from _numbers(f"{name}[{place}]", value)


def _units(topic: str, schema: Any) -> dict[str, str]:
    """The units that `write_mcap` has put into a schema."""
    if schema.encoding != "jsonschema":
        return {}
    properties = json.loads(schema.data).get("properties", {})
    return {f"{topic}.{key}": str(own.get("unit", "")) for key, own in properties.items()}


def _topic(name: str) -> str:
    return name.partition(".")[0]


def _ticks(time: FloatArray) -> list[int]:
    return [round(moment / NANO) for moment in time.tolist()]
