"""Services that load scripts start and stop: PostgreSQL, an S3 server (moto), a proxy, networks that can be disconnected, and clocks that jump."""
import os, shutil, socket, socketserver, subprocess, sys, threading, time
from pathlib import Path
from common import ROOT

# `cargo xtask test` installs it here
S3_PACKAGES = ROOT / ".tmpi/s3-server"


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def wait_for_port(port, host="127.0.0.1"):
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        try:
            socket.create_connection((host, port), 1).close()
            return
        except OSError:
            time.sleep(0.02)
    raise SystemExit(f"nothing listens on {host}:{port}")


class Location:
    """Where a process runs: on this machine, or in a network namespace that can be disconnected."""

    def __init__(self, name=None, host="127.0.0.1"):
        self.name, self.host = name, host
        self.prefix = ["ip", "netns", "exec", name] if name else []


class Network:
    """Network namespaces behind a bridge, each with its own address and link; needs root."""

    def __init__(self):
        self.key, self.locations = f"tmpi{os.getpid() % 10000}", []
        subprocess.run(["ip", "link", "add", self.key, "type", "bridge"], check=True, capture_output=True)
        self.ip("addr", "add", "10.213.0.1/24", "dev", self.key)
        self.ip("link", "set", self.key, "up")

    @staticmethod
    def ip(*words):
        subprocess.run(["ip", *words], check=True)

    def add_location(self):
        n = len(self.locations)
        name, link = f"{self.key}-{n}", f"{self.key}l{n}"
        self.ip("netns", "add", name)
        self.ip("link", "add", link, "type", "veth", "peer", "name", "eth0", "netns", name)
        self.ip("link", "set", link, "master", self.key, "up")
        location = Location(name, f"10.213.0.{n + 2}")
        for words in (["link", "set", "lo", "up"], ["addr", "add", f"{location.host}/24", "dev", "eth0"], ["link", "set", "eth0", "up"]):
            self.ip("-n", name, *words)
        location.link = link
        self.locations.append(location)
        return location

    def set_connected(self, locations, connected):
        for location in locations:
            self.ip("link", "set", location.link, "up" if connected else "down")

    def remove(self):
        for location in self.locations:
            subprocess.run(["ip", "netns", "del", location.name], capture_output=True)
            subprocess.run(["ip", "link", "del", location.link], capture_output=True)
        subprocess.run(["ip", "link", "del", self.key], capture_output=True)


class Engine:
    """A process that listens on its own port."""

    def __init__(self, command, port, location=Location(), env=None):
        self.command, self.port, self.location, self.env = [*location.prefix, *command], port, location, env
        self.start()

    def start(self):
        self.process = subprocess.Popen(self.command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=self.env)
        wait_for_port(self.port, self.location.host)

    def kill(self):
        self.process.kill()
        self.process.wait()


class Postgres:
    """A PostgreSQL server with data and socket in a folder; it can be killed and restarted."""

    PROGRAMS = next((p.parent for p in sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), reverse=True)), None)

    def __init__(self, folder):
        self.folder = folder / "postgres"
        self.folder.mkdir()
        # PostgreSQL refuses to run as root
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
    """Forwards connections, and responds with 503 while `down`."""

    def __init__(self, port):
        proxy, self.down, self.open = self, False, set()

        class Handler(socketserver.BaseRequestHandler):
            def handle(self):
                if proxy.down:
                    self.request.recv(65536)
                    self.request.sendall(b"HTTP/1.1 503 Slow Down\r\ncontent-length: 0\r\nconnection: close\r\n\r\n")
                    return
                upstream = socket.create_connection(("127.0.0.1", port))
                pair = (self.request, upstream)
                proxy.open.add(pair)
                back = threading.Thread(target=copy, args=(upstream, self.request), daemon=True)
                back.start()
                copy(self.request, upstream)
                back.join()
                proxy.open.discard(pair)
                upstream.close()

        class Listener(socketserver.ThreadingTCPServer):
            daemon_threads, allow_reuse_address, request_queue_size = True, True, 128

        self.server = Listener(("127.0.0.1", 0), Handler)
        self.port = self.server.server_address[1]
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def set_down(self, down):
        self.down = down
        for pair in list(self.open) if down else []:
            for s in pair:
                shut_down(s)


def shut_down(s):
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
    shut_down(target)


def s3_server(location=Location()):
    """Starts an S3 server in memory with an empty bucket `photos`."""
    port = free_port()
    paths = [str(S3_PACKAGES), os.environ.get("PYTHONPATH", "")]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in paths if p)}
    engine = Engine([sys.executable, "-m", "moto.server", "-H", location.host, "-p", str(port)], port, location, env)
    import urllib.request
    urllib.request.urlopen(urllib.request.Request(f"http://{location.host}:{port}/photos", method="PUT"), timeout=10)
    return engine


class Clock:
    """Shifts the wall clock of a process (libfaketime); its monotonic clock is unchanged."""

    LIBRARY = next((p for p in Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1")), None)

    def __init__(self, folder):
        self.file = folder / "clock"
        self.set(0)
        self.env = {"LD_PRELOAD": str(self.LIBRARY), "FAKETIME_TIMESTAMP_FILE": str(self.file), "FAKETIME_NO_CACHE": "1", "FAKETIME_DONT_FAKE_MONOTONIC": "1"}

    def set(self, seconds):
        # the process may read the file at any time, so replace it atomically
        part = self.file.with_suffix(".part")
        part.write_text(f"{seconds:+d}s\n")
        part.replace(self.file)
