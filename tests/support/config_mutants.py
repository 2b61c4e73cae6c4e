"""Valid configurations and command lines, spoilt: the same for a seed and a number.

A case is files and the words of a command line. Every base is valid as it stands, and quick: short flights, no waiting.
What is spoilt is drawn from the kinds of mistakes that files and command lines have: types, magnitudes, lengths,
nesting, syntax, names, what a path leads to.
"""

from __future__ import annotations

import copy
import json
import math
import random
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any, get_args, get_origin

import msgspec

from uavctl.config import Config, dump_config, load_config

CONFIG, SPEC, FAULTS, TRACE, MOTION = "mine.toml", "campaign.toml", "faults.toml", "trace.csv", "motion.csv"
RECORDING = "{recording}"  # the runner puts the path of a recording here
NUMBERS = (0.0, -0.0, -1.0, 1e-300, 1e-12, 1e-6, 1e-3, 0.5, 1.0, 7.0, 1e3, 1e6, 1e9, 1e12, 1e17, 1e100, 1e300, -1e300)
ODD: tuple[Any, ...] = (
    math.nan,
    math.inf,
    -math.inf,
    2**31,
    2**63,
    2**64,
    -(2**63),
    10**400,
    True,
    False,
    "",
    "x",
    [],
    [[]],
    {},
    [None],
)
FACTORS = (-1.0, 0.1, 0.5, 0.9, 1.1, 2.0, 10.0, 100.0, 1e4)
TEXTS = (
    "",
    " ",
    "\x00",
    "\x1b[31mred",
    "a\nb",
    "\u202etxt",
    "ü😀",
    "../../../../etc/passwd",
    "/dev/zero",
    "/dev/null",
    "/",
    "~nobody/x",
    "%s%n",
    "[bold]x[/]",
    "\ud7ff",
    "nan",
    "a" * 300,
    "b" * 100_000,
)
WORDS = (
    *(
        "nan",
        "inf",
        "-inf",
        "-1",
        "0",
        "-0.0",
        "1e300",
        "-1e300",
        "1e-300",
        "1e-9",
        "99999",
        "65536",
        "9" * 30,
        "9" * 5000,
    ),
    *(
        "",
        " ",
        "x",
        "\x1b[2J",
        "ü😀",
        "\u202e",
        "--",
        "-",
        "=",
        "a=b",
        "[",
        "{}",
        "{{x}}",
        "1,2,3",
        "nan,nan,nan",
        "1e300,0,0",
    ),
    *(
        "/",
        ".",
        "/dev/zero",
        "/dev/full",
        "/dev/null",
        "no/such/place",
        "pipe",
        "a" * 5000,
        "../..",
        "0x10",
        "1_000",
        "٣",
    ),
    *(
        "--set",
        "--json",
        "--config",
        "--duration",
        "true",
        "[bold]x[/]",
        "udpin://0.0.0.0:99999",
        "udpout://:",
        "tcpin://x:y",
    ),
    *("serial:///dev/null", "natnet://", "udpin://127.0.0.1:-1", "udpin://[::1", "1" + "0" * 400, "smpc.horizon=1e300"),
)

LONG_OPTIONS = ("--duration", "--seconds", "--runs", "--steps", "--states", "--workers")


@dataclass
class Case:
    """One command line with its files.

    Attributes:
        words: Words after the program's name.
        files: Name -> content; a `None` is a FIFO, which nobody writes to.
        note: What was spoilt, for people.
    """

    words: list[str]
    files: dict[str, str | bytes | None] = field(default_factory=dict)
    note: list[str] = field(default_factory=list)


def toml_text(value: Any) -> str:
    """A value as TOML writes it; what TOML has not is written nevertheless."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {toml_text(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml_text, value)) + "]"
    return str(value) if value is not None else "null"


def toml_document(table: dict[str, Any], path: str = "") -> Iterator[str]:
    """A document's lines: plain keys, then tables."""
    tables = {key: value for key, value in table.items() if isinstance(value, dict)}
    lists = {
        key: value
        for key, value in table.items()
        if isinstance(value, list) and value and all(isinstance(entry, dict) for entry in value)
    }
    yield from (f"{key} = {toml_text(value)}" for key, value in table.items() if key not in tables and key not in lists)
    for key, value in tables.items():
        yield f"[{path}{key}]"
        yield from toml_document(value, f"{path}{key}.")
    for key, listed in lists.items():
        for entry in listed:
            yield f"[[{path}{key}]]"
            yield from toml_document(entry, f"{path}{key}.")


def find_leaf_paths(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Path of everything in a document, tables and lists too."""
    if path:
        yield path
    if isinstance(value, dict | list):
        inner: Any = value.items() if isinstance(value, dict) else enumerate(value)
        for key, value in inner:
            yield from find_leaf_paths(value, (*path, key))


def find_ranges(
    section: Any, path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], tuple[float, float, bool]]]:
    """Least and largest number that a key takes, and whether it is a whole one, by the key's path; of lists too."""
    for section_field in msgspec.structs.fields(section):
        key_path = (*path, section_field.encode_name)
        if isinstance(section_field.type, type) and issubclass(section_field.type, msgspec.Struct):
            yield from find_ranges(section_field.type, key_path)
        else:
            result = next(_numbers(section_field.type), None)
            if result is not None:
                yield key_path, result


def _numbers(annotation: Any, metas: tuple[Any, ...] = ()) -> Iterator[tuple[float, float, bool]]:
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        yield from _numbers(arguments[0], (*metas, *arguments[1:]))
    elif annotation in (int, float):
        low = next((m.ge if m.ge is not None else m.gt for m in metas if (m.ge, m.gt) != (None, None)), -1e7)
        high = next((m.le if m.le is not None else m.lt for m in metas if (m.le, m.lt) != (None, None)), 1e7)
        yield low, high, annotation is int
    else:
        for argument in arguments:
            yield from _numbers(argument)


def draw_within(rng: random.Random, low: float, high: float, whole: bool) -> float:
    """A number that a key takes: an end of its range, or anything between, small ones as often as large ones."""
    min_value = max(low, 1e-9) if low >= 0 else min(1e-9, high)
    value = rng.choice((low, high, math.exp(rng.uniform(math.log(min_value), math.log(max(high, 2 * min_value))))))
    if low < 0 < value:
        value *= rng.choice((1, -1))
    return round(value) if whole else value


def nest_value(depth: int, brackets: str) -> str:
    """A value in many brackets."""
    return "[" * depth + "]" * depth if brackets == "[" else "{a=" * depth + "1" + "}" * depth


class Mutants:
    """Cases by number."""

    def __init__(self, seed: int, load_bases: dict[str, dict[str, Any]]) -> None:
        """Make cases of a seed.

        Args:
            seed: The seed.
            load_bases: Name -> valid configuration as a table, with every key in it.
        """
        self._seed = seed
        self._bases = load_bases
        self._ranges = dict(find_ranges(Config))

    def config(self, number: int) -> Case:
        """A spoilt configuration, or a spoilt file beside one, under some command."""
        rng = random.Random(f"{self._seed}/config/{number}")
        name = rng.choice(list(self._bases))
        case = Case([])
        kind = rng.choice(("file",) * 12 + ("set",) * 4 + ("spec", "faults", "trace", "motion"))
        table = copy.deepcopy(self._bases[name])
        quick = [] if rng.random() < 0.04 else ["solver.method=exact"]
        overrides: list[str] = []
        if kind in ("trace", "motion"):
            self._data_file(rng, kind, table, case)
        text = "\n".join(toml_document(table)) + "\n"
        if kind == "file":
            text = self._spoil_document(rng, table, case)
        elif kind == "set":
            overrides = [self._override(rng, table, case) for _ in range(rng.choice((1, 1, 2)))]
        case.files[CONFIG] = text
        case.words = self._command(rng, kind, name, table, case)
        for override in (*overrides, *(quick if case.words[0] != "campaign" else ())):
            case.words += ["--set", override]
        return case

    def command_line(self, number: int) -> Case:
        """A spoilt command line on a good configuration."""
        rng = random.Random(f"{self._seed}/line/{number}")
        case = Case([], {CONFIG: "\n".join(toml_document(self._bases["paper"])) + "\n", "pipe": None})
        table = self._bases["paper"]
        arguments = self._any_command(rng, "paper", table, case)
        if arguments[0] not in ("campaign", "paper", "log", "ctl", "key"):
            arguments += ["--set", "solver.method=exact"]
        for _ in range(rng.choice((1, 1, 1, 2, 3))):
            at = rng.randrange(1, len(arguments) + 1)
            how = rng.choice(("value", "value", "value", "insert", "drop", "twice", "swap"))
            argument = rng.choice(WORDS)
            if how == "value":
                options = [i for i in range(1, len(arguments)) if arguments[i - 1].startswith("--")] or [
                    len(arguments) - 1
                ]
                at = rng.choice(options)
                arguments[at] = argument
            elif how == "insert":
                arguments.insert(at, argument)
            elif how == "drop" and len(arguments) > 2:
                del arguments[at - 1]
            elif how == "twice":
                arguments.insert(at, arguments[at - 1])
            else:
                other_index = rng.randrange(len(arguments))
                arguments[at - 1], arguments[other_index] = arguments[other_index], arguments[at - 1]
            case.note.append(f"{how} {at} {argument[:20]!r}")
        for i, argument in enumerate(arguments[1:], 1):  # long work that is asked for is not refused, so not asked for
            if arguments[i - 1] in LONG_OPTIONS and 4.0 < _number(argument) < 1e7:
                arguments[i] = "1e300"
        # A process cannot be given these in a word.
        case.words = [
            argument.replace("\x00", "").encode("utf-8", "surrogateescape").decode("utf-8", "replace")
            for argument in arguments
        ]
        return case

    def _spoil_document(self, rng: random.Random, table: dict[str, Any], case: Case) -> str:
        if rng.random() < 0.75:
            for _ in range(rng.choice((1, 1, 1, 2, 4))):
                self._spoil_value(rng, table, case)
            return "\n".join(toml_document(table)) + "\n"
        return self._spoil_text(rng, "\n".join(toml_document(table)) + "\n", case)

    def _spoil_value(self, rng: random.Random, table: dict[str, Any], case: Case) -> None:
        paths = [path for path in find_leaf_paths(table) if len(path) > 1 or rng.random() < 0.2]
        if rng.random() < 0.7:  # sections of many keys leave others that matter as much
            section = rng.choice(sorted({str(path[0]) for path in paths}))
            paths = [path for path in paths if path[0] == section]
        path = rng.choice(paths)
        holder: Any = table
        for key in path[:-1]:
            holder = holder[key]
        value = holder[path[-1]]
        how, new = self._other(rng, value)
        known = self._ranges.get(tuple(key for key in path if isinstance(key, str)))
        if known is not None and isinstance(value, int | float) and rng.random() < 0.7:
            new = draw_within(rng, *known)
            how = f"within {new:g}"
        case.note.append(f"{'.'.join(map(str, path))}: {how}")
        if how == "deleted" and isinstance(holder, dict):
            del holder[path[-1]]
        elif how == "renamed" and isinstance(holder, dict):
            holder[rng.choice(("horizn", "x" * 1000, "ü", "a-b", "0"))] = holder.pop(path[-1])
        else:
            holder[path[-1]] = new

    def _other(self, rng: random.Random, value: Any) -> tuple[str, Any]:
        """What is put in the place of a value, and its name."""
        if isinstance(value, bool):
            return "odd", rng.choice((*ODD, 1, 0, "true"))
        if isinstance(value, int | float):
            how = rng.choice(("factor", "factor", "number", "number", "odd"))
            new: Any = rng.choice(NUMBERS) if how == "number" else rng.choice(ODD)
            if how == "factor":
                new = value * rng.choice(FACTORS) if math.isfinite(value) else -value
            if isinstance(value, int) and isinstance(new, float) and math.isfinite(new) and rng.random() < 0.8:
                new = int(new)
            return f"{how} {str(new)[:30]}", new
        if isinstance(value, str):
            new = rng.choice((*TEXTS, *ODD[:8]))
            return f"text {str(new)[:20]!r}", new
        if isinstance(value, list):
            how = rng.choice(("longer", "shorter", "much longer", "odd", "nested", "bigger", "shifted"))
            if how == "shifted" and all(isinstance(number, int | float) for number in value):
                offset = rng.choice((-3.0, -0.7, 0.7, 3.0))  # limits that leave zero out, targets beyond a wall
                return f"shifted by {offset:g}", [number + offset for number in value]
            if how in ("bigger", "shifted"):
                factor = rng.choice((*FACTORS, 1e9, 1e200))
                return f"times {factor:g}", _scaled(value, factor)
            longer = [*value, *(value[-1:] or [1.0])]
            count = rng.choice((100, 1000, 20_000))
            much = (value or [rng.choice((1.0, [1.0, 2.0], [1.0, 2.0, 3.0]))]) * max(count // max(len(value), 1), 2)
            choices: dict[str, Any] = {
                "longer": longer,
                "shorter": value[:-1],
                "much longer": much,
                "odd": rng.choice(ODD),
                "nested": [value, value],
            }
            return how, choices[how]
        return rng.choice((("deleted", None), ("renamed", None), ("odd", rng.choice(ODD))))

    def _spoil_text(self, rng: random.Random, text: str, case: Case) -> str:
        lines = text.split("\n")
        at = rng.randrange(len(lines))
        how = rng.choice(
            ("delete", "twice", "cut", "garbage", "nest", "nest", "huge", "keys", "tables", "dotted", "bits")
        )
        case.note.append(f"text {how} at {at + 1}")
        if how == "delete":
            del lines[at : at + rng.choice((1, 3))]
        elif how == "twice":
            lines.insert(at, lines[at])
        elif how == "cut":
            return text[: rng.randrange(len(text))]
        elif how == "garbage":
            lines.insert(
                at,
                rng.choice(("\x00", "=", "[", "]]", "x", '"""', "a.b.c = 1", "ü = 1", "[a]\n[a]", "x = 1e", "\ufeff")),
            )
        elif how == "nest":
            lines.insert(at, f"deep = {nest_value(rng.choice((20, 200, 5000, 100_000)), rng.choice('[{'))}")
        elif how == "huge":
            lines.insert(at, f'huge = "{"a" * rng.choice((100_000, 10_000_000))}"')
        elif how == "keys":
            lines.insert(at, "\n".join(f"key{i} = {i}" for i in range(rng.choice((1000, 50_000)))))
        elif how == "tables":
            fence_text = '[[fence]]\nstate = "north"\nside = "upper"\ntimes_s = [0.0]\nvalues = [2.0]\n'
            lines.append(fence_text * rng.choice((100, 5000)))
        elif how == "dotted":
            lines.insert(at, f"{'a.' * rng.choice((50, 5000))}b = 1")
        else:
            data = bytearray(text.encode())
            for _ in range(5):
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            return data.decode("latin-1")
        return "\n".join(lines)

    def _override(self, rng: random.Random, table: dict[str, Any], case: Case) -> str:
        """A spoilt `key.path=value`."""
        other_table = copy.deepcopy(table)
        path = rng.choice([path for path in find_leaf_paths(table) if all(isinstance(key, str) for key in path)])
        holder: Any = other_table
        for key in path[:-1]:
            holder = holder[key]
        how = rng.choice(("value",) * 6 + ("nest", "no value", "deep key", "odd key", "quotes", "two"))
        value = toml_text(self._other(rng, holder[path[-1]])[1])
        name = ".".join(path)
        tail = rng.choice((".x", "[0]", " ", "..", ".\u00fc", "\u202e"))
        quote = rng.choice(('"', '"""', "'", "[1,", "{a=", "#", "1 # 2", "1\n2=3"))
        text = {
            "value": f"{name}={value}",
            "nest": f"{name}={nest_value(rng.choice((100, 5000, 30_000)), rng.choice('[{'))}",
            "no value": rng.choice((name, f"{name}=", "=", "=1", "")),
            "deep key": f"{'a.' * rng.choice((5, 2000, 30_000))}b=1",
            "odd key": f"{name}{tail}={value}",
            "quotes": f"{name}={quote}",
            "two": f"{name}={value}={value}",
        }[how]
        case.note.append(f"--set {text[:60]}")
        return text.replace("\x00", "")[:120_000]

    def _data_file(self, rng: random.Random, kind: str, table: dict[str, Any], case: Case) -> None:
        """A spoilt file beside the configuration."""
        rows = [f"{0.1 * i:.1f},0.5,0.5,-1.0" for i in range(20)] if kind == "motion" else ["0.02"] * 50
        how = rng.choice(
            ("long", "wide", "word", "huge", "empty", "odd", "binary", "none", "fifo", "device", "negative")
        )
        at = rng.randrange(len(rows))
        content: str | bytes | None = "\n".join(rows)
        name = TRACE if kind == "trace" else MOTION
        if how == "long":
            row_count = rng.choice((1000, 30_000, 500_000))
            content = "\n".join(f"{0.1 * i:.1f},0.5,0.5,-1.0" if kind == "motion" else "0.02" for i in range(row_count))
        elif how == "wide":
            rows[at] += ",1" * rng.choice((1, 100_000))
        elif how == "word":
            rows[at] = rng.choice(("x", "nan", "inf", "1e300", "1e300,1e300,1e300,1e300", "\x00", "1;2", "٣"))
        elif how == "negative":
            rows[at] = f"-{rows[at]}"
        elif how == "huge":
            rows[at] = "9" * rng.choice((400, 1_000_000))
        elif how == "empty":
            rows = []
        elif how == "odd":
            rows.insert(at, "")
        content = content if how == "long" else "\n".join(rows)
        if how == "binary":
            content = rng.randbytes(1000)
        if how == "fifo":
            content = None
        if how not in ("none", "device"):
            case.files[name] = content
        given = "/dev/zero" if how == "device" else name
        if kind == "trace":
            table["link"] |= {"model": "trace", "trace_file": given}
        else:
            table["mission"]["trajectory"] = {"file": given}
        case.note.append(f"{kind} file: {how}")

    def _command(self, rng: random.Random, kind: str, name: str, table: dict[str, Any], case: Case) -> list[str]:
        if kind == "spec":
            spec = {
                "name": "many",
                "config": rng.choice(("paper", "mine.toml")),
                "runs": 2,
                "steps": 5,
                "master": 0,
                "controller": [
                    {"name": "one", "kind": "lqg"},
                    {"name": "two", "kind": rng.choice(("pid", "hold-last"))},
                ],
                "link": [{"name": "good", "set": ["link.loss=0.1"]}, {"name": "bad", "set": ["link.loss=0.3"]}],
                "disturbance": [{"name": "plain", "kind": "gaussian", "scale": 1.0, "bias": 0.0}],
            }
            case.files[SPEC] = self._spoil_document(rng, spec, case)
            return ["campaign", SPEC, "--workers", "1", "--out", "results"]
        if kind == "faults":
            script = {
                "fault": [
                    {"at_s": 0.1, "kind": "blackout", "for_s": 0.5},
                    {"at_s": 0.1, "kind": "mode", "name": "POSCTL"},
                ]
            }
            case.files[FAULTS] = self._spoil_document(rng, script, case)
            return [*self._sim(), "--config", CONFIG, "--faults", FAULTS]
        commands: list[Callable[[], list[str]]] = [
            *[lambda: ["design", "--config", CONFIG]] * 8,
            *[lambda: self._solve(name)] * 3,
            *[self._loopback] * 6,
            *[self._sim_configured] * 2,
            self._check,
            self._fly,
        ]
        if kind == "set":
            commands += [self._replay, self._whatif, self._replay, self._whatif]
        return rng.choice(commands)()

    def _any_command(self, rng: random.Random, name: str, table: dict[str, Any], case: Case) -> list[str]:
        return rng.choice(
            (
                lambda: ["design", "--config", CONFIG, "--json"],
                lambda: self._solve(name),
                lambda: [*self._loopback(), "--seed", "3", "--goto", "1,1,-1"],
                lambda: [*self._loopback(), "--arm", "--takeoff", "1.5"],
                lambda: [*self._sim_configured(), "--vehicles", "2", "--airborne"],
                self._check,
                self._fly,
                lambda: [*self._fly(), "--goto", "1,1,-1", "--live", "--live-port", "18765"],
                lambda: ["bench", "--config", CONFIG, "--states", "1", "--seed", "1"],
                lambda: [
                    "paper",
                    "--runs",
                    "1",
                    "--steps",
                    "4",
                    "--seed",
                    "1",
                    "--tau",
                    "4",
                    "--out",
                    "paper",
                    "--workers",
                    "1",
                ],
                lambda: self._spec_line(case),
                self._replay,
                self._whatif,
                lambda: ["log", "info", RECORDING],
                lambda: ["log", "report", RECORDING, "--out", "page.html", "--rehearsals", "0"],
                lambda: ["log", "export", RECORDING, "--to", "csv", "--out", "tables"],
                lambda: ["log", "compare", RECORDING, RECORDING],
                lambda: ["log", "recover", RECORDING, "--out", "back.mcap"],
                lambda: ["identify", RECORDING, "--out", "found.toml"],
                lambda: ["ctl", "goto", "1,2,-1", "--control", "."],
                lambda: ["ctl", "status", "--vehicle", "x", "--control", "."],
                lambda: ["key", "new", "key"],
                lambda: ["key", "show", CONFIG],
            )
        )()

    def _spec_line(self, case: Case) -> list[str]:
        case.files[SPEC] = (
            'name = "many"\nconfig = "paper"\nruns = 2\nsteps = 5\n[[controller]]\nname = "one"\nkind = "lqg"\n'
        )
        return ["campaign", SPEC, "--workers", "1", "--runs", "2", "--out", "results"]

    def _solve(self, name: str) -> list[str]:
        zeros = len(self._bases[name]["sets"]["state_lower"])
        return ["solve", "--config", CONFIG, "--state", ",".join(["0.5", *["0"] * (zeros - 1)])]

    def _loopback(self) -> list[str]:
        return ["loopback", "--config", CONFIG, "--duration", "2", "--out", "flight"]

    def _sim(self) -> list[str]:
        return [
            "sim",
            "--vehicle",
            "udpout://127.0.0.1:24540",
            "--mocap",
            "udpout://127.0.0.1:24560",
            "--duration",
            "0.3",
        ]

    def _sim_configured(self) -> list[str]:
        return [*self._sim(), "--config", CONFIG, "--speed", "10"]

    def _check(self) -> list[str]:
        urls = ["--vehicle", "udpin://127.0.0.1:24541", "--mocap", "udpin://127.0.0.1:24561"]
        return ["check", "--config", CONFIG, *urls, "--seconds", "0.2", "--set", "check.wait_s=0.1"]

    def _fly(self) -> list[str]:
        urls = ["--vehicle", "udpin://127.0.0.1:24542", "--mocap", "udpin://127.0.0.1:24562"]
        return ["fly", "--config", CONFIG, *urls, "--duration", "0.3", "--out", "flight", "--control", "."]

    def _replay(self) -> list[str]:
        return ["log", "replay", RECORDING]

    def _whatif(self) -> list[str]:
        return ["log", "whatif", RECORDING, "--out", "again"]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0


def _scaled(value: Any, factor: float) -> Any:
    if isinstance(value, list):
        return [_scaled(number, factor) for number in value]
    return value * factor if isinstance(value, int | float) and not isinstance(value, bool) else value


def load_bases() -> dict[str, dict[str, Any]]:
    """Both presets with every key, and the first one with a mission, a fence and a fault."""
    result = {name: tomllib.loads(dump_config(load_config(name))) for name in ("paper", "room-hahn-stursberg")}
    for table in result.values():
        table["security"]["require"] = ["vehicle", "mocap"]
    mission = [
        "mission.waypoints=[[1, 1, -1], [0, 0, -1]]",
        "fence=[{state='north', side='upper', times_s=[0.0, 5.0], values=[2.9, 2.5]}]",
        "sim.fault=[{at_s=0.5, kind='blackout', for_s=0.3}]",
    ]
    result["mission"] = tomllib.loads(dump_config(load_config("room-hahn-stursberg", mission)))
    return result
