"""Engines that load scripts start and stop: PostgreSQL, an S3 server (moto), what stands between them and the nodes, and clocks that jump."""
import os, shutil, socket, socketserver, subprocess, sys, threading, time
from pathlib import Path
from common import ROOT

# where `cargo xtask test` puts it
S3_PACKAGES = ROOT / ".tmpi/s3-server"


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def listening(port, host="127.0.0.1"):
    until = time.monotonic() + 30
    while time.monotonic() < until:
        try:
            socket.create_connection((host, port), 1).close()
            return
        except OSError:
            time.sleep(0.02)
    raise SystemExit(f"nothing listens on {host}:{port}")


class Place:
    """Where a process runs: this machine, or a part of a network that can be cut off."""

    def __init__(self, name=None, host="127.0.0.1"):
        self.name, self.host = name, host
        self.prefix = ["ip", "netns", "exec", name] if name else []


class Network:
    """Places behind a bridge, each with an address and a link of its own. Only root makes one."""

    def __init__(self):
        self.key, self.places = f"tmpi{os.getpid() % 10000}", []
        subprocess.run(["ip", "link", "add", self.key, "type", "bridge"], check=True, capture_output=True)
        self.ip("addr", "add", "10.213.0.1/24", "dev", self.key)
        self.ip("link", "set", self.key, "up")

    @staticmethod
    def ip(*words):
        subprocess.run(["ip", *words], check=True)

    def place(self):
        n = len(self.places)
        name, link = f"{self.key}-{n}", f"{self.key}l{n}"
        self.ip("netns", "add", name)
        self.ip("link", "add", link, "type", "veth", "peer", "name", "eth0", "netns", name)
        self.ip("link", "set", link, "master", self.key, "up")
        place = Place(name, f"10.213.0.{n + 2}")
        for words in (["link", "set", "lo", "up"], ["addr", "add", f"{place.host}/24", "dev", "eth0"], ["link", "set", "eth0", "up"]):
            self.ip("-n", name, *words)
        place.link = link
        self.places.append(place)
        return place

    def set(self, places, cut):
        for place in places:
            self.ip("link", "set", place.link, "down" if cut else "up")

    def remove(self):
        for place in self.places:
            subprocess.run(["ip", "netns", "del", place.name], capture_output=True)
            subprocess.run(["ip", "link", "del", place.link], capture_output=True)
        subprocess.run(["ip", "link", "del", self.key], capture_output=True)


class Engine:
    """A process on a port of its own."""

    def __init__(self, command, port, place=Place(), env=None):
        self.command, self.port, self.place, self.env = [*place.prefix, *command], port, place, env
        self.start()

    def start(self):
        self.process = subprocess.Popen(self.command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=self.env)
        listening(self.port, self.place.host)

    def kill(self):
        self.process.kill()
        self.process.wait()


class Postgres:
    """A PostgreSQL server in a folder, at a socket there; it can be killed and started again."""

    PROGRAMS = next((p.parent for p in sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), reverse=True)), None)

    def __init__(self, folder):
        self.folder = folder / "postgres"
        self.folder.mkdir()
        # PostgreSQL refuses to be root's
        self.user = {"user": "postgres", "group": "postgres"} if os.geteuid() == 0 else {}
        if self.user:
            folder.chmod(0o755)
            shutil.chown(self.folder, "postgres", "postgres")
        self.run("initdb", "-D", self.folder / "db", "-U", "postgres", "-A", "trust")
        self.start()
        self.run("createdb", "-h", self.folder, "-U", "postgres", "tmpi")
        self.url = f"postgres://postgres@localhost/tmpi?host={self.folder}"

    def run(self, program, *words):
        subprocess.run([self.PROGRAMS / program, *words], check=True, capture_output=True, cwd=self.folder, **self.user)

    def start(self):
        command = [self.PROGRAMS / "postgres", "-D", self.folder / "db", "-k", self.folder, "-c", "listen_addresses=", "-c", "max_connections=200"]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=self.folder, **self.user)
        ready = [self.PROGRAMS / "pg_isready", "-h", self.folder, "-U", "postgres"]
        while subprocess.run(ready, capture_output=True).returncode != 0:
            time.sleep(0.05)

    def kill(self):
        self.process.kill()
        self.process.wait()


class Proxy:
    """Passes connections on, and answers 503 while `away`."""

    def __init__(self, port):
        proxy, self.away, self.open = self, False, set()

        class Handler(socketserver.BaseRequestHandler):
            def handle(self):
                if proxy.away:
                    self.request.recv(65536)
                    self.request.sendall(b"HTTP/1.1 503 Slow Down\r\ncontent-length: 0\r\nconnection: close\r\n\r\n")
                    return
                there = socket.create_connection(("127.0.0.1", port))
                pair = (self.request, there)
                proxy.open.add(pair)
                back = threading.Thread(target=copy, args=(there, self.request), daemon=True)
                back.start()
                copy(self.request, there)
                back.join()
                proxy.open.discard(pair)
                there.close()

        class Listener(socketserver.ThreadingTCPServer):
            daemon_threads, allow_reuse_address, request_queue_size = True, True, 128

        self.server = Listener(("127.0.0.1", 0), Handler)
        self.port = self.server.server_address[1]
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def set(self, away):
        self.away = away
        for pair in list(self.open) if away else []:
            for s in pair:
                shut(s)


def shut(s):
    try:
        s.shutdown(socket.SHUT_RDWR)
    except OSError:
        pass


def copy(source, target):
    try:
        while data := source.recv(65536):
            target.sendall(data)
    except OSError:
        pass
    shut(target)


def s3_server(place=Place()):
    """An empty bucket `photos` in memory."""
    port = free_port()
    paths = [str(S3_PACKAGES), os.environ.get("PYTHONPATH", "")]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in paths if p)}
    engine = Engine([sys.executable, "-m", "moto.server", "-H", place.host, "-p", str(port)], port, place, env)
    import urllib.request
    urllib.request.urlopen(urllib.request.Request(f"http://{place.host}:{port}/photos", method="PUT"), timeout=10)
    return engine


class Clock:
    """The time of day as one process sees it (libfaketime); what it measures durations by goes on as it does."""

    LIBRARY = next((p for p in Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1")), None)

    def __init__(self, folder):
        self.file = folder / "clock"
        self.set(0)
        self.env = {"LD_PRELOAD": str(self.LIBRARY), "FAKETIME_TIMESTAMP_FILE": str(self.file), "FAKETIME_NO_CACHE": "1", "FAKETIME_DONT_FAKE_MONOTONIC": "1"}

    def set(self, seconds):
        # read at any time: whole or not at all
        part = self.file.with_suffix(".part")
        part.write_text(f"{seconds:+d}s\n")
        part.replace(self.file)
