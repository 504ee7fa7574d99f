"""Rooms of several nodes over a `nats-server` of its own: what another node costs, and how long its end is felt."""
import shutil, socket, subprocess, sys, tempfile, time
from pathlib import Path
from common import PROGRAM, Server, Table, check

# Debian keeps it where only root looks
NATS = shutil.which("nats-server") or shutil.which("nats-server", path="/usr/sbin")


class Nats:
    def __init__(self):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.start()

    def start(self):
        self.process = subprocess.Popen([NATS, "-a", "127.0.0.1", "-p", str(self.port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while True:
            try:
                return socket.create_connection(("127.0.0.1", self.port), 1).close()
            except OSError:
                time.sleep(0.01)

    def kill(self):
        self.process.kill()
        self.process.wait()


class Epochs:
    """When each epoch of a room was first seen, by what a viewer is told."""

    def __init__(self, socket, fields):
        self.socket, self.fields, self.epoch, self.seen = socket, fields, 0, {}
        if socket.status != 101:
            raise SystemExit(f"a viewer does not come in: {socket.status}")
        socket.socket.setblocking(False)

    def read(self, kinds):
        alive = True
        try:
            some = self.socket.socket.recv(1 << 18)
            alive = bool(some)
        except BlockingIOError:
            some = b""
        except OSError:
            return False
        self.socket.buffer += some
        for message in self.socket.messages():
            if message is None:
                return False
            if message[0] >> 3 == kinds[0]:
                self.epoch = self.fields(self.fields(message)[kinds[0]]).get(18, 0)
            elif message[0] >> 3 == kinds[1] and self.epoch:
                number = self.fields(self.fields(message)[kinds[1]]).get(1, 0)
                self.seen.setdefault(self.epoch, {}).setdefault(number, time.monotonic())
        return alive


def median(values):
    return sorted(values)[len(values) // 2] if values else float("nan")


def nodes(stream, full):
    if not NATS:
        print("skipped, no nats-server")
        return
    from live import HELLO, VIDEO, Socket, fields
    kinds, nats = (HELLO, VIDEO), Nats()
    url = f"nats://127.0.0.1:{nats.port}"
    node = lambda name: Server("--nats", url, "--node", name)
    ready = lambda server: wait(lambda: server.metric("tmpi_live_nats_connected") == 1, "a node hears the others")
    rounds = 20 if full else 5
    table = Table("round", "join at another node", "sent on after, median", "worst", "frames missing there", "viewer of another node goes on after", "viewer of the killed node after", "epochs")
    ends, backs = [], []
    a, b = node("a"), node("b")
    folder = tempfile.TemporaryDirectory(prefix="tmpi-nodes-")
    for n in range(rounds):
        ready(a), ready(b)
        room = f"room{n}"
        addresses = ",".join(f"http://{s.address[0]}:{s.address[1]}/live/{room}" for s in (a, b))
        publisher = subprocess.Popen([PROGRAM, "live", "publish", stream, "--to", addresses, "--times", "100000"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wait(lambda: b.get(f"/v1/live/{room}")[2].find(b'"publishing":true') > 0, "the other node knows the room")
        time.sleep(2)
        began, path = time.monotonic(), f"/v1/live/{room}/subscribe"
        here, there = Epochs(Socket(a, path), fields), Epochs(Socket(b, path), fields)
        while not there.seen and time.monotonic() - began < 10:
            there.read(kinds)
        joined = time.monotonic() - began
        log = open(Path(folder.name) / f"{n}.log", "w+")
        other = subprocess.Popen([PROGRAM, "live", "watch", addresses], stdout=subprocess.DEVNULL, stderr=log)
        until = time.monotonic() + 5
        while time.monotonic() < until:
            here.read(kinds), there.read(kinds)
            time.sleep(0.001)
        epoch = there.epoch
        both = sorted(set(here.seen[epoch]) & set(there.seen[epoch]))[5:]
        late = [there.seen[epoch][f] - here.seen[epoch][f] for f in both if f > both[0] + 30]
        missing = both[-1] - both[0] + 1 - len(both)
        a.kill()
        killed = time.monotonic()
        went_on = None
        while time.monotonic() - killed < 15 and went_on is None:
            alive = there.read(kinds)
            check(alive, "the viewer of the other node stays")
            if there.epoch != epoch and there.seen.get(there.epoch):
                went_on = min(there.seen[there.epoch].values()) - killed
            time.sleep(0.001)
        back = None
        while time.monotonic() - killed < 15 and back is None:
            there.read(kinds)
            log.seek(0)
            if f"epoch {there.epoch}" in log.read():
                back = time.monotonic() - killed
            time.sleep(0.01)
        other.kill(), other.wait(), publisher.kill(), publisher.wait()
        here.socket.close(), there.socket.close()
        check(missing == 0, f"all frames come to the other node: {missing} are missing")
        check(went_on is not None and went_on <= 2, f"viewers of another node go on within 2 s: {went_on}")
        check(back is not None, "the viewer of the killed node comes back")
        check(joined <= 1, f"join at another node within a second: {joined:.2f}")
        ends.append(went_on or 99), backs.append(back or 99)
        table.row(n, f"{joined * 1e3:.0f} ms", f"{median(late) * 1e3:.1f} ms", f"{max(late) * 1e3:.1f} ms", missing, f"{ends[-1] * 1e3:.0f} ms", f"{backs[-1] * 1e3:.0f} ms", len(there.seen))
        a.start()
    print(f"\nkill -9 of the room's node: viewers of another go on after {median(ends) * 1e3:.0f} ms (worst {max(ends) * 1e3:.0f}), its own after {median(backs) * 1e3:.0f} ms (worst {max(backs) * 1e3:.0f})")
    ready(a)
    cost(a, b, stream, Table("viewers at another node", "for", "CPU of the publisher's node", "of theirs", "resident there before / after", "frames/s"))
    for server in (a, b):
        log = Path(server.log.name).read_text()
        check("panicked" not in log, f"nothing panicked: {log[-500:]}")
        server.stop()
    nats.kill()


def cost(a, b, stream, table):
    from live import Readers, Viewer, cpu, publisher
    sends = publisher(a, "cost", stream)
    wait(lambda: b.get("/v1/live/cost")[2].find(b'"publishing":true') > 0, "the other node knows the room")
    for count in (0, 1, 100):
        readers = Readers()
        viewers = [Viewer(b, "cost") for _ in range(count)]
        for viewer in viewers:
            readers.add(viewer)
        time.sleep(2)
        spent, began, frames, before = [cpu(s.process) for s in (a, b)], time.monotonic(), sum(v.frames for v in viewers), b.resident_mib()
        time.sleep(8)
        took = time.monotonic() - began
        now = [cpu(s.process) for s in (a, b)]
        rate = (sum(v.frames for v in viewers) - frames) / took / max(count, 1)
        check(sum(v.lost for v in viewers) == 0, f"{sum(v.lost for v in viewers)} frames lost")
        table.row(count, f"{took:.0f} s", *(f"{100 * (n - s) / took:.0f} %" for s, n in zip(spent, now)), f"{before:.0f} / {b.resident_mib():.0f} MiB", f"{rate:.1f}")
        readers.stop()
    sends.kill()
    sends.wait()


def wait(true_now, what, seconds=30):
    until = time.monotonic() + seconds
    while not true_now():
        if time.monotonic() > until:
            sys.exit(f"{seconds} s are over before {what}")
        time.sleep(0.01)
