#!/usr/bin/env python3
"""Hundreds of viewers of a room, some of which pause reading; rooms on several nodes whose origin is killed; hostile publishers. Measures memory, lost
frames, and the time until viewers are live again."""
import argparse, base64, os, random, selectors, socket, struct, subprocess, tempfile, threading, time
from pathlib import Path
from common import LAB, PROGRAM, Server, Table, check, finish

HELLO, VIDEO, GEOMETRY, SNAPSHOT, SOUND, STATISTICS, BYE, CREDIT = range(1, 9)
SIZE = (320, 240)


def varint(value):
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes(out) + bytes([value])


def field(number, value):
    if isinstance(value, int):
        return varint(number << 3) + varint(value) if value else b""
    value = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(value)) + value


def hello(codec="avc1.42e01e", size=SIZE, version=1):
    return field(HELLO, field(1, version) + field(2, codec) + field(3, size[0]) + field(4, size[1]))


def video(number, data, key=False):
    return field(VIDEO, field(1, number) + field(2, time.time_ns() // 1000) + field(3, int(key)) + field(5, data))


def fields(message):
    """Field numbers of a message with their values, bytes or integers."""
    at, found = 0, {}

    def number():
        nonlocal at
        value, shift = 0, 0
        while True:
            byte = message[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    while at < len(message):
        tag = number()
        kind = tag & 7
        if kind == 0:
            value = number()
        elif kind == 2:
            length = number()
            value = message[at:at + length]
            at += length
        else:
            length = 8 if kind == 1 else 4
            value, at = message[at:at + length], at + length
        found[tag >> 3] = value
    return found


class Socket:
    """A minimal WebSocket client that can pause reading and send malformed frames."""

    def __init__(self, server, path, buffer=None):
        self.socket = socket.socket()
        if buffer:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
            # loopback segments do not fit into such a small window and would wait for ever rarer probes, so use the size of a network's segments
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, 1448)
        self.socket.settimeout(30)
        self.socket.connect(server.address)
        key = base64.b64encode(os.urandom(16)).decode()
        head = f"GET {path} HTTP/1.1\r\nhost: localhost\r\nconnection: upgrade\r\nupgrade: websocket\r\n"
        self.socket.sendall(f"{head}sec-websocket-version: 13\r\nsec-websocket-key: {key}\r\n\r\n".encode())
        answer = b""
        while b"\r\n\r\n" not in answer:
            some = self.socket.recv(4096)
            if not some:
                break
            answer += some
        head, _, rest = answer.partition(b"\r\n\r\n")
        self.status = int(head.split(b" ")[1]) if head else 0
        self.buffer, self.closed = bytearray(rest), False

    def raw(self, opcode, payload, length=None):
        """Sends one frame masked with zeros; `length` may differ from the payload's."""
        length = len(payload) if length is None else length
        head = bytes([length]) if length < 126 else b"\x7e" + struct.pack(">H", length) if length < 65536 else b"\x7f" + struct.pack(">Q", length)
        self.socket.sendall(bytes([opcode]) + bytes([head[0] | 128]) + head[1:] + bytes(4) + payload)

    def send(self, message):
        self.raw(0x82, message)

    def messages(self):
        """Yields complete messages from the buffer, and None when the server has closed."""
        buffer = self.buffer
        while len(buffer) >= 2:
            length, head = buffer[1] & 127, 2
            if length == 126 and len(buffer) >= 4:
                length, head = struct.unpack_from(">H", buffer, 2)[0], 4
            elif length == 127 and len(buffer) >= 10:
                length, head = struct.unpack_from(">Q", buffer, 2)[0], 10
            elif length >= 126:
                break
            if len(buffer) < head + length:
                break
            opcode, payload = buffer[0] & 15, bytes(buffer[head:head + length])
            # remove it before the yield, so that a caller that stops iterating does not get it again
            del buffer[:head + length]
            if opcode == 8:
                yield None
            elif opcode in (0, 2):
                yield payload

    def receive(self, seconds=30):
        """Yields messages as they arrive, until the server closes."""
        deadline = time.monotonic() + seconds
        while True:
            for message in self.messages():
                if message is None:
                    self.closed = True
                    return
                yield message
            self.socket.settimeout(max(0.01, deadline - time.monotonic()))
            try:
                some = self.socket.recv(1 << 16)
            except TimeoutError:
                return
            except OSError:
                some = b""
            if not some:
                self.closed = True
                return
            self.buffer += some

    def bye_reason(self, seconds=30):
        """The reason in the server's BYE; empty if the server closes without one, None if it does not close."""
        for message in self.receive(seconds):
            kinds = fields(message)
            if BYE in kinds:
                return fields(kinds[BYE]).get(1, b"").decode()
        return "" if self.closed else None

    def close(self):
        self.socket.close()


class Viewer:
    """One viewer, with counts of what it has received."""

    def __init__(self, server, room, buffer=None):
        self.server, self.room, self.rcvbuf = server, room, buffer
        self.frames, self.lost, self.last, self.messages, self.bytes = 0, 0, None, 0, 0
        self.reconnects = 0
        # time of the first frame after the last HELLO
        self.begun = None
        self.open()

    def open(self):
        self.began = time.monotonic()
        self.first, self.tiles, self.shown = None, False, False
        self.socket = Socket(self.server, f"/v1/live/{self.room}/subscribe", self.rcvbuf)
        if self.socket.status != 101:
            raise SystemExit(f"a viewer cannot connect: {self.socket.status}")
        self.socket.socket.setblocking(False)
        self.process(b"")

    def read(self):
        """Returns False when the server has closed."""
        try:
            some = self.socket.socket.recv(1 << 18)
        except BlockingIOError:
            return True
        except OSError:
            return False
        return bool(some) and self.process(some)

    def process(self, some):
        self.bytes += len(some)
        self.socket.buffer += some
        for message in self.socket.messages():
            if message is None:
                return False
            self.messages += 1
            kind = message[0] >> 3
            if kind == VIDEO:
                number = fields(fields(message)[VIDEO]).get(1, 0)
                if self.last is not None and number > self.last + 1:
                    self.lost += number - self.last - 1
                self.frames, self.last, self.shown = self.frames + 1, number, True
                self.begun = self.begun or time.monotonic()
            elif kind == HELLO:
                self.last, self.begun = None, None
            elif kind == SNAPSHOT:
                self.tiles = True
            elif kind == GEOMETRY and self.last is not None and not self.frames:
                self.tiles = True
            if self.first is None and self.shown and self.tiles:
                self.first = time.monotonic() - self.began
        return True


class Readers:
    """A thread that reads for many viewers."""

    def __init__(self):
        self.selector, self.viewers, self.running = selectors.DefaultSelector(), [], True
        self.lock, self.closed = threading.Lock(), []
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def add(self, viewer):
        with self.lock:
            self.viewers.append(viewer)
            self.selector.register(viewer.socket.socket, selectors.EVENT_READ, viewer)

    def pause(self, viewer):
        with self.lock:
            self.selector.unregister(viewer.socket.socket)

    def resume(self, viewer):
        with self.lock:
            self.selector.register(viewer.socket.socket, selectors.EVENT_READ, viewer)

    def run(self):
        while self.running:
            with self.lock:
                ready = self.selector.select(0) if self.viewers else []
                for key, _ in ready:
                    if not key.data.read():
                        self.selector.unregister(key.fileobj)
                        self.closed.append(key.data)
            # reading many messages at once costs less than reading each alone
            time.sleep(0.01)

    def stop(self):
        self.running = False
        self.thread.join()
        for viewer in self.viewers:
            viewer.socket.close()


def cpu(process):
    """CPU seconds."""
    text = open(f"/proc/{process.pid}/stat").read().rsplit(")", 1)[1].split()
    return (int(text[11]) + int(text[12])) / os.sysconf("SC_CLK_TCK")


def unsent(server):
    """Most unsent bytes that the kernel holds for one of the server's connections."""
    port, most = f"{server.address[1]:04X}", 0
    for line in open("/proc/net/tcp").readlines()[1:]:
        words = line.split()
        if words[1].endswith(":" + port) and words[3] == "01":
            most = max(most, int(words[4].split(":")[0], 16))
    return most


def publisher(server, room, stream):
    """Starts a publisher and waits for its first frame."""
    address = f"http://{server.address[0]}:{server.address[1]}/live/{room}"
    command = [PROGRAM, "live", "publish", stream, "--room", address, "--times", "100000"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 30
    while server.get(f"/v1/live/{room}/frames/latest/atlas")[0] != 200 and time.monotonic() < deadline:
        time.sleep(0.05)
    return process


def audience(server, stream, count, stalled, seconds, table):
    room = f"room{count}"
    publishing = publisher(server, room, stream)
    readers, viewers = Readers(), []
    before = server.resident_mib()
    for n in range(count):
        # small receive buffers, so that the backlog of stalled viewers stays on the server
        viewers.append(Viewer(server, room, 65536 if n < stalled else None))
        readers.add(viewers[-1])
    time.sleep(3)
    joined, pausing = server.resident_mib(), viewers[:stalled]
    spent, began, highest, most = cpu(server.process), time.monotonic(), 0.0, 0
    frames = viewers[-1].frames
    samples, back = [], []
    # half of them resume before the server disconnects them, half after
    naps = [min(8, seconds / 4), min(20, seconds / 2)]
    asleep = {}
    while time.monotonic() - began < seconds:
        now = time.monotonic() - began
        for n, viewer in enumerate(pausing):
            nap = naps[n % 2]
            if id(viewer) not in asleep and now > 1 and now + nap + 3 < seconds:
                readers.pause(viewer)
                asleep[id(viewer)] = now
            elif id(viewer) in asleep and asleep[id(viewer)] is not None and now - asleep[id(viewer)] > nap:
                asleep[id(viewer)] = None
                threading.Thread(target=wake, args=(viewer, viewers[-1], readers, back), daemon=True).start()
        if all(v is None for v in asleep.values()) and len(back) == len(pausing) and now + naps[1] + 3 < seconds:
            asleep = {}
        resident = server.resident_mib()
        samples.append(resident)
        highest, most = max(highest, resident), max(most, unsent(server))
        time.sleep(0.5)
    spent, took = cpu(server.process) - spent, time.monotonic() - began
    healthy = viewers[stalled:]
    rate = (viewers[-1].frames - frames) / took
    lost = sum(v.lost for v in healthy)
    first = sorted(v.first or 99 for v in viewers)
    third = len(samples) // 3
    flat = max(samples[-third:]) - max(samples[:third])
    check(not readers.closed or stalled, f"no viewer is disconnected: {len(readers.closed)} were")
    check(max(samples[-third:]) < max(samples[:third]) * 1.05 + 4, f"memory stays flat: {max(samples[:third]):.0f}, then {max(samples[-third:]):.0f} MiB")
    if stalled:
        each = (highest - joined) / stalled
        check(each <= 1 and most <= 1 << 20, f"a stalled viewer takes at most 1 MiB: {each:.2f} MiB, {most} B in the kernel")
        check(back and max(back) <= 1, f"viewers are live again within a second: {[round(b, 2) for b in back]}")
        check(lost == 0, f"viewers that read lose no frame: {lost} lost")
        check(first[-1] <= 0.3, f"viewers get the first picture with depth within 300 ms: {first[-1]:.3f} s")
    table.row(count, stalled, f"{took:.0f} s", f"{rate:.1f}", lost, f"{first[len(first) // 2] * 1e3:.0f} ms", f"{first[-1] * 1e3:.0f} ms",
              f"{before:.0f} / {joined:.0f} / {highest:.0f} MiB", f"{flat:+.1f} MiB", f"{most >> 10} KiB", f"{max(back, default=0) * 1e3:.0f} ms",
              f"{100 * spent / took:.0f} %", f"{1e6 * spent / took / max(1, count) / max(rate, 1):.1f} µs", f"{os.getloadavg()[0]:.1f}")
    readers.stop()
    publishing.kill()
    publishing.wait()
    return rate, lost


def wake(viewer, other, readers, back):
    """Resumes reading; records how long the viewer takes to catch up with `other`."""
    began = time.monotonic()
    try:
        # the backlog may end with the server's close frame
        alive, quiet = True, 0
        while alive and quiet < 3:
            before = viewer.bytes
            alive = viewer.read()
            quiet = quiet + 1 if viewer.bytes == before else 0
            if other.last is not None and viewer.last is not None and viewer.last >= other.last - 3:
                break
        if not alive:
            viewer.socket.close()
            viewer.reconnects += 1
            viewer.last = None
            viewer.open()
        viewer.lost = 0
        while not (viewer.last is not None and other.last is not None and viewer.last >= other.last - 3) and time.monotonic() - began < 10:
            if not viewer.read():
                break
            time.sleep(0.002)
        back.append(time.monotonic() - began)
        readers.resume(viewer)
    except OSError as error:
        check(False, f"a paused viewer resumes: {error}")


def units(stream):
    """Splits an H.264 stream into access units with one picture slice each; returns (data, is_key)."""
    data, starts = Path(stream).read_bytes(), []
    at = data.find(b"\0\0\1")
    while at >= 0:
        starts.append(at - 1 if at and data[at - 1] == 0 else at)
        at = data.find(b"\0\0\1", at + 3)
    units, unit = [], b""
    for start, stop in zip(starts, starts[1:] + [len(data)]):
        nal = data[start:stop]
        kind = nal[nal.index(1) + 1] & 31
        unit += nal
        if kind in (1, 5):
            units.append((unit, kind == 5))
            unit = b""
    return units


def hostile(server, stream, table, full):
    room = "/v1/live/cellar/publish"
    pictures = units(stream)

    def connect(first=None):
        # the previous publisher may still be connected
        for _ in range(200):
            client = Socket(server, room)
            if first is None:
                return client
            client.send(first)
            for message in client.receive(5):
                if CREDIT in fields(message):
                    return client
                break
            client.close()
            time.sleep(0.05)
        raise SystemExit("the room is still taken")

    def on_connect(action):
        def play():
            client = connect()
            action(client)
            return client
        return play

    def after_hello(action, first=hello()):
        def play():
            client = connect(first)
            action(client)
            return client
        return play

    def flood(client):
        began, number = time.monotonic(), 0
        while number < 10_000 and time.monotonic() - began < 10:
            client.send(video(number, pictures[number % len(pictures)][0], number == 0))
            number += 1

    def mutated(count):
        def play(client):
            rng, credit, number = random.Random(1), 2, 0
            sent = 0
            while sent < count:
                while credit:
                    unit, key = pictures[sent % len(pictures)]
                    data = bytearray(unit)
                    for _ in range(rng.randrange(1, 20)):
                        data[rng.randrange(len(data))] = rng.randrange(256)
                    client.send(video(number, bytes(data), key or number == 0))
                    credit, number, sent = credit - 1, number + 1, sent + 1
                for message in client.receive(10):
                    kinds = fields(message)
                    if CREDIT in kinds:
                        credit += fields(kinds[CREDIT]).get(1, 0)
                        break
                    if BYE in kinds:
                        mutated.reasons.append(fields(kinds[BYE]).get(1, b"").decode())
                        client.close()
                        new = connect(hello())
                        client.socket, client.buffer = new.socket, new.buffer
                        credit, number = 2, 0
                        break
                else:
                    return
            client.send(field(HELLO, b""))
        return play

    mutated.reasons = []
    many = 200_000 if full else 3_000
    cases = [
        ("a text message", on_connect(lambda c: c.raw(0x81, b"hello")), "binary"),
        ("bytes that are no message", on_connect(lambda c: c.send(b"\xff" * 60)), "not a readable message"),
        ("an empty message", on_connect(lambda c: c.send(b"")), "unknown kind"),
        ("video before HELLO", on_connect(lambda c: c.send(video(0, b"x", True))), "HELLO"),
        ("unknown version", on_connect(lambda c: c.send(hello(version=9))), "version"),
        ("100 000×9 frames", on_connect(lambda c: c.send(hello(size=(100_000, 9)))), "100000"),
        ("an unknown codec", on_connect(lambda c: c.send(hello("hev1.1"))), "hev1"),
        ("half a million empty chunks", on_connect(lambda c: c.send(field(GEOMETRY, b"\x12\0" * 500_000))), "chunks"),
        ("a frame that claims 4 EiB", on_connect(lambda c: c.raw(0x82, b"x", 1 << 62)), ""),
        ("2 MiB of fragments", on_connect(lambda c: [c.raw(0x02, bytes(4096))] + [c.raw(0x00, bytes(4096)) for _ in range(511)]), ""),
        ("no message", on_connect(lambda c: None), "nothing came"),
        ("first frame is no key frame", after_hello(lambda c: c.send(video(0, b"x"))), "key"),
        ("frames out of order", after_hello(lambda c: [c.send(video(0, pictures[0][0], True)), c.send(video(5, b"x"))]), "was due"),
        ("a frame of 1 MiB + 1 byte", after_hello(lambda c: c.send(video(0, bytes((1 << 20) + 1), True))), "over"),
        ("a message for viewers", after_hello(lambda c: c.send(field(SNAPSHOT, b""))), "do not send"),
        ("10 000 frames at once", after_hello(flood), "credit"),
        ("invalid video", after_hello(lambda c: [c.send(video(0, b"\0\0\1\x65zzz", True)), c.send(video(1, b"", True))]), "nothing came"),
        (f"{many} damaged frames", after_hello(mutated(many)), "do not send"),
        ("no message after HELLO", after_hello(lambda c: None), "nothing came"),
    ]
    publishing = publisher(server, "attic", stream)
    watcher, readers = Viewer(server, "attic"), Readers()
    readers.add(watcher)
    for name, play, words in cases:
        frames, began = watcher.frames, time.monotonic()
        try:
            client = play()
            reason = client.bye_reason(20)
            client.close()
        except OSError as error:
            reason = f"connection lost ({error})" if not words or "credit" in words else f"no reason: {error}"
        took = time.monotonic() - began
        check(reason is not None, f"{name}: disconnected within 20 s")
        reason = reason or ""
        check(words in reason or reason.startswith("connection lost"), f"{name}: disconnected with {words!r}: {reason!r}")
        rate = (watcher.frames - frames) / max(took, 0.1)
        table.row(name, reason[:70], f"{took:.1f} s", f"{server.resident_mib():.0f} MiB", f"{rate:.0f}" if took > 1 else "", watcher.lost)
    check(watcher.lost == 0 and not readers.closed, f"another room is not affected: {watcher.lost} frames lost")
    sender = Socket(server, "/v1/live/attic/subscribe")
    sender.send(hello())
    reason = sender.bye_reason(20)
    check("viewers" in (reason or ""), f"a viewer that sends is disconnected: {reason!r}")
    readers.stop()
    publishing.kill()
    publishing.wait()
    return mutated.reasons


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true")
    args.add_argument("--seconds", type=int)
    args.add_argument("--only", choices=["viewers", "hostile", "edges"])
    args = args.parse_args()
    folder = tempfile.TemporaryDirectory(prefix="tmpi-live-")
    subprocess.run([LAB, "live-bench", "--only", "measured", "--frames", "150", "--views", "100000", "--files", folder.name], check=True, stdout=subprocess.DEVNULL)
    stream = str(Path(folder.name) / "measured.h264")
    if args.only in (None, "viewers"):
        server = Server("--set", "limits.connections=4096", "--set", "limits.connections-per-address=4096")
        seconds = args.seconds or (600 if args.full else 40)
        table = Table("viewers", "stalled", "for", "frames/s", "lost by others", "first view, median", "worst", "resident before / joined / peak", "last third − first",
                      "in a socket", "live again", "CPU of the server", "CPU per viewer and frame", "load")
        audience(server, stream, 20, 0, min(seconds, 10), table)
        audience(server, stream, 200, 10, seconds, table)
        count = 400
        while count <= (1000 if args.full else 400):
            rate, _ = audience(server, stream, count, 0, 10, table)
            if rate < 25:
                break
            count += 200
        server.stop()
    if args.only in (None, "edges"):
        # edges imports this module
        from edge_nodes import edges
        edges(stream, args.full)
    if args.only in (None, "hostile"):
        server = Server()
        table = Table("publisher sends", "disconnect reason", "after", "resident", "frames/s of another room", "lost there")
        reasons = hostile(server, stream, table, args.full)
        print(f"\ndamaged frames: disconnected {len(reasons)} times: {sorted(set(reasons))[:5]}")
        check(server.process.poll() is None, "the server is still running")
        log = Path(server.log.name).read_text()
        check("panicked" not in log, f"no thread panics: {log[-500:]}")
        server.stop()
    finish()


if __name__ == "__main__":
    main()
