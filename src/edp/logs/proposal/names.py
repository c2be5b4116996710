"""Kinds, units and roles derived from column names in English and German, and from instrument tags."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from edp.logs.units import normalise_unit
from edp.signals import UNIT_ENDINGS, UNIT_TAILS, UNITS, Kind

_LONGEST = 200
"""Maximum number of examined characters of a name."""
_PARTS = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss"})

KIND_WORDS: Mapping[str, Kind] = {
    word: kind
    for kind, words in {
        Kind.PILOT_PRESSURE: "pilot vorsteuerdruck eppr",
        Kind.PRESSURE: "pressure press druck",
        Kind.ANGULAR_VELOCITY: "rpm drehzahl omega gyro angvel revs tacho tachometer",
        Kind.ACCELERATION: "acceleration accel acc beschleunigung",
        Kind.VELOCITY: "velocity vel speed geschwindigkeit geschw",
        Kind.ANGLE: "angle ang winkel pitch roll yaw heading",
        Kind.POSITION: "position pos stroke hub weg displacement disp verschiebung hoehe abstand",
        Kind.FORCE: "force kraft",
        Kind.FLOW: "flow durchfluss volumenstrom",
        Kind.MASS: "mass masse gewicht weight payload",
        Kind.TEMPERATURE: "temperature temperatur temp",
        Kind.VOLTAGE: "voltage spannung volt",
        Kind.CURRENT: "strom amp ampere",
        Kind.RATIO: "percent prozent ratio duty pwm opening oeffnung",
    }.items()
    for word in words.split()
}
"""Words that indicate a kind. The first match in a name counts. ``current`` is excluded because it may mean the
present.
"""
_LONG = 4
"""Minimum length of a word that is also found within a compound, as in ``Kolbendruck``."""
ROLE_WORDS: Mapping[str, str] = {
    word: role
    for role, words in {
        "reference": "soll sollwert ref reference set setpoint desired des target demand demanded requested vorgabe "
        "fuehrungsgroesse r",
        "command": "command cmd ctrl control u valve ventil joystick lever hebel pilot pwm duty input stellgroesse "
        "pedal",
        "measured": "ist istwert act actual meas measured mess messwert fb feedback y output "
        "sensor cell transducer encoder gauge bus supply battery",
        "label": "flag status state mode id label condition fault error leak stable zustand fehler stale valid online "
        "alive",
    }.items()
    for word in words.split()
}
_PARTS_OF_SETS = frozenset(["est", "val", "train", "test", "id"])
_GLUED = re.compile(r"(pos|vel|acc|ang)(a|act|d|des|r|ref|m|meas|cmd)")
"""Pattern of a kind and a role in one word, as in robot programs."""
_GLUED_ROLES = {
    role: named
    for named, roles in {"measured": "a act m meas", "reference": "d des r ref", "command": "cmd"}.items()
    for role in roles.split()
}
_HYDRAULIC = frozenset(
    ("cyl", "cylinder", "zylinder", "pump", "pumpe", "port", "chamber", "kammer", "rod", "head", "piston", "supply")
)
"""Words that make a single P at the end of a name mean pressure."""
_TURNS, _SPEEDS = frozenset(("ang", "angular")), frozenset(("vel", "velocity", "speed"))
_ERRORS = frozenset(["error", "err", "deviation", "abweichung", "regelabweichung", "residual", "residuum"])
_COUNTERS = frozenset(
    ("cycle", "zyklus", "index", "idx", "sample", "row", "zeile", "nr", "no", "number", "count", "counter")
)
_TIMES = frozenset(
    [
        "time",
        "zeit",
        "t",
        "timestamp",
        "zeitstempel",
        "uhrzeit",
        "tout",
        "sec",
        "seconds",
        "second",
        "sekunde",
        "elapsed",
    ]
)
_SAMPLE_TIMES = frozenset(
    ("ts", "dt", "sampletime", "sample_time", "samplingtime", "tastzeit", "abtastzeit", "t_s", "dt_s", "dt_ms", "dt_us")
)
_JOINTS = frozenset(("joint", "joints", "gelenk", "achse", "elbow", "shoulder", "wrist", "knee", "hip", "ankle"))
_TAG = re.compile(r"([PTF])([SIT])(\d{1,3})")
_TAGS: Mapping[str, Kind] = {"P": Kind.PRESSURE, "T": Kind.TEMPERATURE, "F": Kind.FLOW}
"""Kinds by the first letter of an instrument tag (ISA-5.1), as in PS1 or TT12."""


def words_of(name: str) -> tuple[str, ...]:
    """Return the words of a name in lower case with umlauts written out: ``CylVel_1`` gives cyl, vel, 1."""
    return tuple(part.lower() for part in _PARTS.findall(name[:_LONGEST].translate(_UMLAUTS)))


def kind_by_word(name: str) -> Kind | None:
    """Return the kind named by a word; None without such a word, or if the rate of another kind is named."""
    words = words_of(name)
    if not _TURNS.isdisjoint(words) and not _SPEEDS.isdisjoint(words):
        return Kind.ANGULAR_VELOCITY
    for word, kind in KIND_WORDS.items():
        if word in words or (len(word) > _LONG and any(word in other for other in words)):
            return kind
    glued = _match_glued(words)
    if glued is not None:
        return KIND_WORDS.get(glued[1])
    # Cyl_P, pump_p: what is said before tells that it is no gain.
    return Kind.PRESSURE if words[-1:] == ("p",) and not _HYDRAULIC.isdisjoint(words[:-1]) else None


def _match_glued(words: Sequence[str]) -> re.Match[str] | None:
    """Match a first word composed of kind and role: ``posd``, ``velact``, ``accref``."""
    return _GLUED.fullmatch(words[0]) if words else None


def is_error_name(name: str) -> bool:
    """Return whether a name denotes a deviation, which follows from two other columns."""
    return not _ERRORS.isdisjoint(words_of(name))


def is_joint(name: str) -> bool:
    """Return whether a name denotes a joint of an arm or a leg."""
    return not _JOINTS.isdisjoint(words_of(name))


def kind_by_tag(name: str) -> Kind | None:
    """Return the kind of an instrument tag, which is a weak hint."""
    tag = _TAG.fullmatch(name)
    return None if tag is None else _TAGS[tag[1]]


def tag_family(name: str) -> str:
    """Return the common letters of tags of one kind; empty for other names."""
    tag = _TAG.fullmatch(name)
    return "" if tag is None else tag[1] + tag[2]


def unit_by_ending(name: str) -> str | None:
    """Return the unit at the end of a name with several words: ``valve_percent``, ``pA_bar``."""
    for tail, unit in UNIT_TAILS.items():
        if name.endswith("_" + tail) and len(name) > len(tail) + 1:
            return unit
    words = [word for word in words_of(name) if not word.isdigit()]
    return UNIT_ENDINGS.get(words[-1]) if len(words) > 1 else None


def find_unit(stated: str | None) -> str | None:
    """Return a stated unit in EDP's spelling; None if it is unknown."""
    unit = normalise_unit(stated)
    return unit if unit in UNITS else None


def role_by_word(name: str) -> str:
    """Return ``reference``, ``command``, ``measured`` or ``label`` if a word of the name means it; otherwise empty."""
    words = words_of(name)
    # A letter is a role where it begins a name; R is that of a rod, of a side or of a reference, which stands alone.
    alone = all(word.isdigit() or word in _PARTS_OF_SETS for word in words[1:])
    letters = words[:1] if alone or words[:1] != ("r",) else ()
    roles = {
        ROLE_WORDS[word] for word in (*letters, *words) if word in ROLE_WORDS and (len(word) > 1 or word in letters)
    }
    glued = _match_glued(words)
    if not roles and glued is not None:
        return _GLUED_ROLES[glued[2]]
    # A reference of a valve is a reference, its measured opening is measured.
    return next((role for role in ("reference", "measured", "label", "command") if role in roles), "")


_STAMP_ENDINGS = frozenset(("ts", "timestamp", "stamp", "zeitstempel"))
_STAMP = re.compile(r"(?:^|[./])header[./]stamp(?:[./](?:n?secs?|nanosec))?$")


def is_counter_name(name: str) -> bool:
    """Return whether a word of a name counts something."""
    return any(word in _COUNTERS for word in words_of(name))


def is_time_name(name: str) -> bool:
    """Return whether a name denotes time."""
    return any(word in _TIMES for word in words_of(name)[:1])


def is_sample_time_name(name: str) -> bool:
    """Return whether a name denotes the time between two rows."""
    return "".join(name.split()).lower() in _SAMPLE_TIMES


def is_stamp_name(name: str) -> bool:
    """Return whether a field of a message is the time at which it was sent.

    A stamp of ROS, whole or in its two parts.
    """
    return _STAMP.search(name) is not None


def ends_as_stamp(name: str) -> bool:
    """Return whether a name of several words ends like a time stamp: ``pressure_ts``."""
    words = words_of(name)
    return len(words) > 1 and words[-1] in _STAMP_ENDINGS
