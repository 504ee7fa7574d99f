"""A room from outside: its messages, a WebSocket client, viewers that count what they receive, and a publisher."""
import base64, os, selectors, socket, struct, subprocess, threading, time
from common import PROGRAM

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


def publisher(server, room, stream):
    """Starts a publisher and waits for its first frame."""
    address = f"http://{server.address[0]}:{server.address[1]}/live/{room}"
    command = [PROGRAM, "live", "publish", stream, "--room", address, "--times", "100000"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 30
    while server.get(f"/v1/live/{room}/frames/latest/atlas")[0] != 200 and time.monotonic() < deadline:
        time.sleep(0.05)
    return process
