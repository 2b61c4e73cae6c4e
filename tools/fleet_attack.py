"""Attack a fleet in moving cells over real UDP, with real processes, and judge it by the true vehicles.

`uavctl cameras` and `uavctl fleet fly` fly `docs/examples/cross.toml` against four simulated vehicles, which this
process serves. Each attack is made when two vehicles are near to each other. Everything has a network of its own where
the system permits that. Only processes that were started here are signalled.

    python tools/fleet_attack.py [--attack cameras-killed ...] [--rounds 1] [--json]
    python tools/fleet_attack.py --attack none --vehicles 8     # eight vehicles in real time, in a room of 6 m

Exit code 1: two vehicles collided, or one is still in the air at the end but for one that its pilot flies, or two never
came near to each other, so that nothing was attacked.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from socket import AF_INET, SOCK_DGRAM, socket
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.recording.export import read_table
from sim.fleet import make_fleet
from sim.server import serve_all
from sim.simulation import Peers
from uavctl.config import load_config
from uavctl.errors import UavctlError
from uavctl.records import Truth

ROOT = Path(__file__).resolve().parents[1]
NEAR_M = 1.6  # distance of a pair at which the attack begins: within cells d is 0.35 m, at their starts 1 m or more
AWAY_M = 0.5  # way that both have flown by then
IN_AIR_M = 0.3  # height above which a vehicle is in the air
START_LIMIT_S, CROSS_S, END_LIMIT_S = 90.0, 25.0, 90.0
PX4_POSCTL = (1 | 80, 3 << 16)  # base mode with custom mode and manual input; PX4 main mode POSCTL
FLEET_FILE = "cross.toml"
FIRST_START_M = {4: (-0.6, -0.5), 8: (-0.6, -1.5)}  # north and east; the others stand 1 m apart in two rows
ROOM = ("sets.state_lower=[-3,-1.5,-inf,-3,-1.5,-inf,-3,-1,-inf]", "sets.state_upper=[3,1.5,inf,3,1.5,inf,0,1,inf]")
CALM = (  # as in the example
    "limits.accel_mps2=[2.0, 2.0, 1.5]",
    "sets.input_lower=[-2.0, -2.0, -1.5]",
    "sets.input_upper=[2.0, 2.0, 1.5]",
)


@dataclass
class Outcome:
    """What the true vehicles did."""

    attack: str
    closest_m: float | None = None  # of all pairs, from the attack on
    collisions: int = 0
    away_m: float | None = None  # largest distance from a target, north and east, before the end is ordered
    missed_ticks: int | None = None  # of all daemons; None: a recording cannot be read
    in_air: int = 0  # vehicles in the air at the end
    fleet_code: int | None = None  # exit code of `uavctl fleet fly`; None: it had to be killed
    attacked_s: float | None = None  # when, since the start; None: two vehicles never came near
    landed_s: float | None = None  # when all were on the ground after it


class Scene:
    """Simulated vehicles in a thread, and the processes that fly them.

    Args:
        folder: Folder for recordings and outputs.
        vehicles: Number of vehicles.
    """

    def __init__(self, folder: Path, vehicles: int) -> None:
        self.folder, self.vehicles = folder, vehicles
        self.truths: dict[int, Truth] = {}
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.blind: set[int] = set()
        self.exchanged: tuple[int, int] | None = None
        self.collisions = 0
        self._is_over = threading.Event()
        self._peers: list[Peers] = []
        self._ready = threading.Semaphore(0)
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def _serve(self) -> None:
        north_m, east_m = FIRST_START_M[self.vehicles]
        last_m = east_m + self.vehicles // 2 - 1
        config = load_config(
            "room-px4",
            [
                f"sim.start_position_m=[{north_m},{east_m},-0.2]",
                ROOM[0],
                f"sets.state_upper=[3,1.5,inf,{last_m + 0.4},1.5,inf,0,1,inf]",  # where its row ends
                "target.position_m=[0,0,-1.2]",
                "sim.camera.rate_hz=50",
            ],
        )
        urls = "udpout://127.0.0.1:14540,udpout://127.0.0.1:14640"
        setups = make_fleet(config, urls, "udpout://127.0.0.1:14660", self.vehicles, lambda _: None)
        setups = tuple(replace(setup, on_truth=self._make_receiver(i)) for i, setup in enumerate(setups))
        send_position = Peers.send_position

        def send(peers: Peers, at_ns: int, data: bytes) -> None:
            """Send a position, of another vehicle or not at all where the attack asks for it."""
            if peers not in self._peers:
                self._peers.append(peers)
            number = self._peers.index(peers)
            if self.exchanged is not None and number in self.exchanged:
                peers = self._peers[self.exchanged[1 - self.exchanged.index(number)]]
            if number not in self.blind:
                send_position(peers, at_ns, data)

        Peers.send_position = send  # type: ignore[method-assign, assignment]
        try:
            encounters = serve_all(
                setups,
                duration_s=None,
                airborne=False,
                on_ready=lambda _: self._ready.release(),
                stop=self._is_over.is_set,
            )
            self.collisions = len(encounters.collisions)
        finally:
            Peers.send_position = send_position  # type: ignore[method-assign]

    def _make_receiver(self, number: int) -> Callable[[Truth], None]:
        def receive(truth: Truth) -> None:
            self.truths[number] = truth

        return receive

    def __enter__(self) -> Scene:
        self._thread.start()
        for _ in range(self.vehicles):
            if not self._ready.acquire(timeout=30.0):
                raise SystemExit("the simulated vehicles do not start")
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
                process.wait()
        while daemons := self.find_daemons():
            for pid in daemons:
                os.kill(pid, signal.SIGKILL)
            time.sleep(0.1)
        self._is_over.set()
        self._thread.join(10.0)

    def start(self, name: str, *arguments: str) -> None:
        """Start a command of `uavctl`; its output goes to a file of its name."""
        with (self.folder / f"{name}.txt").open("wb") as output:
            self.processes[name] = subprocess.Popen(
                [sys.executable, "-m", "uavctl", *arguments], cwd=self.folder, stdout=output, stderr=output
            )

    def find_daemons(self) -> list[int]:
        """Find the processes of the daemons: those whose recordings go to this folder."""
        daemons = []
        for path in Path("/proc").glob("[0-9]*/cmdline"):
            try:
                arguments = path.read_bytes().split(b"\0")
                is_own = (path.parent / "cwd").resolve() == self.folder.resolve()
            except OSError:  # it has ended
                continue
            if is_own and any(b"run_fleet_daemon" in argument for argument in arguments):
                daemons.append(int(path.parent.name))
        return sorted(daemons)

    @property
    def positions_m(self) -> Any:
        """True positions (N, 3)."""
        return np.array([self.truths[i].position_m for i in sorted(self.truths)])

    def measure_closest_m(self) -> float:
        """Return the least distance of two vehicles of which one is in the air."""
        places_m = self.positions_m
        pairs = [(i, j) for i, j in combinations(range(len(places_m)), 2) if min(places_m[[i, j], 2]) < -IN_AIR_M]
        return min((float(np.linalg.norm(places_m[i] - places_m[j])) for i, j in pairs), default=np.inf)

    def count_in_air(self) -> int:
        """Count the vehicles in the air."""
        return int((self.positions_m[:, 2] < -IN_AIR_M).sum())


def signal_daemon(scene: Scene, number: int) -> None:
    """Send a signal to the daemon of the second vehicle."""
    daemons = scene.find_daemons()
    os.kill(daemons[1], number)


def take_over(_: Scene) -> None:
    """Let the pilot of the second vehicle switch to POSCTL."""
    with socket(AF_INET, SOCK_DGRAM) as port:
        port.bind(("127.0.0.1", 14641))
        port.settimeout(2.0)
        address = port.recvfrom(2048)[1]
        link = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        base, custom = PX4_POSCTL
        command = link.command_long_encode(2, 1, mavlink.MAV_CMD_DO_SET_MODE, 0, base, custom >> 16, 0, 0, 0, 0, 0)
        port.sendto(command.pack(link), address)


def send_foreign_positions(_: Scene) -> None:
    """Send positions of another place to the second vehicle, as a second sender would."""
    link = mavlink.MAVLink(None, srcSystem=200, srcComponent=1)

    def send() -> None:
        with socket(AF_INET, SOCK_DGRAM) as port:
            for _ in range(1500):
                usec = time.monotonic_ns() // 1000
                message = link.vision_position_estimate_encode(usec, 0.3, 0.3, -1.2, 0.0, 0.0, 0.0)
                port.sendto(message.pack(link), ("127.0.0.1", 14561))
                time.sleep(0.02)

    threading.Thread(target=send, daemon=True).start()


ATTACKS: dict[str, Callable[[Scene], object]] = {
    "none": lambda _: None,
    "cameras-killed": lambda scene: scene.processes["cameras"].kill(),
    "cameras-stopped": lambda scene: scene.processes["cameras"].send_signal(signal.SIGSTOP),
    "fleet-killed": lambda scene: scene.processes["fleet"].kill(),
    "fleet-stopped": lambda scene: scene.processes["fleet"].send_signal(signal.SIGSTOP),
    "daemon-killed": lambda scene: signal_daemon(scene, signal.SIGKILL),
    "daemon-stopped": lambda scene: signal_daemon(scene, signal.SIGSTOP),
    "blind": lambda scene: scene.blind.add(1),
    "exchanged": lambda scene: setattr(scene, "exchanged", (1, 2)),
    "pilot": take_over,
    "second-cameras": lambda scene: scene.start("cameras-2", "cameras", FLEET_FILE),
    "second-fleet": lambda scene: scene.start(
        "fleet-2", "fleet", "fly", FLEET_FILE, "--arm", "--takeoff", "1.2", "--out", "flights-2"
    ),
    "foreign-positions": send_foreign_positions,
    "land": lambda scene: scene.start("land", "fleet", "land", FLEET_FILE),
    "interrupted": lambda scene: scene.processes["fleet"].send_signal(signal.SIGINT),
}


def write_fleet_file(path: Path, vehicles: int) -> None:
    """Write the example with four vehicles, or one like it with more in a larger room."""
    text = (ROOT / "docs/examples" / FLEET_FILE).read_text()
    if vehicles != 4:
        text = text.partition("[[vehicle]]")[0]
        north_m, east_m = FIRST_START_M[vehicles]
        for number in range(vehicles):
            row, place = divmod(number, vehicles // 2)
            goal_m = -3.0 * (north_m + row) + 0.3, -1.2 * (east_m + place)  # from each row across the other one
            text += f"""
[[vehicle]]
name = "vehicle-{number + 1}"
config = "room-px4"
vehicle = "udpin://0.0.0.0:{14540 + number}"
mocap = "udpin://0.0.0.0:{14560 + number}"
cameras = "udpin://0.0.0.0:{14660 + number}"
set = {[*ROOM, *CALM, f"target.position_m=[{goal_m[0]:.2f}, {goal_m[1]:.2f}, -1.2]"]}
"""
    path.write_text(text)


def read_targets_m(path: Path) -> Any:
    """Read the targets (N, 2) of the vehicles of a fleet file."""
    rows = [entry for vehicle in tomllib.loads(path.read_text())["vehicle"] for entry in vehicle["set"]]
    return np.array([json.loads(row.partition("=")[2])[:2] for row in rows if row.startswith("target.position_m")])


def count_missed_ticks(folder: Path) -> int | None:
    """Count the ticks that the daemons missed, by their recordings."""
    paths = sorted(folder.glob("*/flight.mcap"))
    try:
        return sum(int(read_table(path, "/uavctl/decision")["missed_ticks"].to_numpy().sum()) for path in paths)
    except UavctlError:  # a daemon was killed while it wrote
        return None


def attack(name: str, folder: Path, vehicles: int) -> Outcome:
    """Fly, attack and judge."""
    outcome = Outcome(name)
    folder.mkdir(parents=True)
    write_fleet_file(folder / FLEET_FILE, vehicles)
    targets_m = read_targets_m(folder / FLEET_FILE)
    with Scene(folder, vehicles) as scene:
        scene.start("cameras", "cameras", FLEET_FILE)
        scene.start("fleet", "fleet", "fly", FLEET_FILE, "--arm", "--takeoff", "1.2", "--out", "flights")
        begun_s, begins_m, end_s, closest_m = time.monotonic(), None, None, np.inf
        while True:
            time.sleep(0.02)
            now_s = time.monotonic() - begun_s
            if len(scene.truths) < vehicles:
                continue
            if begins_m is None:
                begins_m = scene.positions_m
            if outcome.attacked_s is None:
                moved_m = np.linalg.norm((scene.positions_m - begins_m)[:, :2], axis=1)
                if (moved_m > AWAY_M).sum() >= 2 and scene.measure_closest_m() < NEAR_M:
                    outcome.attacked_s, end_s = now_s, now_s + CROSS_S
                    ATTACKS[name](scene)
                elif now_s > START_LIMIT_S:
                    break
                continue
            closest_m = min(closest_m, scene.measure_closest_m())
            if outcome.landed_s is None and scene.count_in_air() <= (1 if name == "pilot" else 0):
                outcome.landed_s = now_s
            fleet = scene.processes["fleet"]
            if end_s is not None:
                outcome.away_m = float(np.linalg.norm(scene.positions_m[:, :2] - targets_m, axis=1).max())
            if end_s is not None and now_s > end_s and name != "fleet-stopped" and fleet.poll() is None:
                fleet.send_signal(signal.SIGINT)
                end_s = None
            is_ended = fleet.poll() is not None or name == "fleet-stopped"
            if (is_ended and outcome.landed_s is not None) or now_s > outcome.attacked_s + CROSS_S + END_LIMIT_S:
                break
        outcome.closest_m = closest_m if np.isfinite(closest_m) else None
        outcome.in_air, outcome.fleet_code = scene.count_in_air(), scene.processes["fleet"].poll()
    outcome.collisions, outcome.missed_ticks = scene.collisions, count_missed_ticks(folder / "flights")
    return outcome


def main(arguments: list[str]) -> int:
    """Make the attacks; return 1 if one failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--attack", nargs="+", choices=tuple(ATTACKS), default=list(ATTACKS))
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--vehicles", type=int, choices=tuple(FIRST_START_M), default=4)
    parser.add_argument("--out", type=Path, help="folder of the recordings, which are not kept without it")
    parser.add_argument("--json", action="store_true", help="print each attack as a line of JSON")
    options = parser.parse_args(arguments)
    if "UAVCTL_NETWORK" not in os.environ and shutil.which("unshare"):
        command = ["unshare", "-n", "sh", "-c", 'ip link set lo up && exec "$@"', "sh", sys.executable, *sys.argv]
        if subprocess.run([*command[:2], "true"], check=False, capture_output=True).returncode == 0:
            os.execvpe(command[0], command, {**os.environ, "UAVCTL_NETWORK": "own"})
    has_failed = False
    with tempfile.TemporaryDirectory(prefix="uavctl-") as short:  # locks of its own; sockets want short names
        os.environ |= {"HOME": short, "XDG_RUNTIME_DIR": short, "TMPDIR": short, "PYTHONPATH": str(ROOT)}
        for number in range(options.rounds):
            for name in options.attack:
                folder = (options.out or Path(short)).resolve() / f"{name}-{number}"
                outcome = attack(name, folder, options.vehicles)
                most_in_air = 1 if name == "pilot" else 0
                has_failed = has_failed or outcome.collisions > 0 or outcome.in_air > most_in_air
                has_failed = has_failed or outcome.attacked_s is None
                fields = asdict(outcome)
                text = json.dumps(fields) if options.json else ", ".join(f"{k} {v}" for k, v in fields.items())
                print(text, flush=True)  # noqa: T201
    return 1 if has_failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
