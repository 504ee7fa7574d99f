"""Shared parts of the load scripts: a server on a free port with data in a temporary folder, a client, pictures, and tables.

Runs `target/release/tmpi`, or the program in `TMPI`, and `tmpi-lab` beside it. Scripts connect only to servers that they start.
"""
import atexit, contextlib, http.client, json, os, shutil, signal, socket, sqlite3, ssl, struct, subprocess, sys, tempfile, threading, time, zlib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = os.environ.get("TMPI", str(ROOT / "target/release/tmpi"))
LAB = str(Path(PROGRAM).with_name("tmpi-lab"))


def status_kib(pid, field):
    try:
        for line in open(f"/proc/{pid}/status"):
            if line.startswith(field + ":"):
                return int(line.split()[1])
    except (OSError, ValueError):
        pass
    return 0


def cpu(process):
    """CPU seconds."""
    text = open(f"/proc/{process.pid}/stat").read().rsplit(")", 1)[1].split()
    return (int(text[11]) + int(text[12])) / os.sysconf("SC_CLK_TCK")


def children(pid):
    """Process ids of direct children."""
    found = []
    for name in os.listdir("/proc"):
        if name.isdigit():
            try:
                stat = open(f"/proc/{name}/stat").read()
            except OSError:
                continue
            if int(stat.rsplit(")", 1)[1].split()[1]) == pid:
                found.append(int(name))
    return found


class Server:
    """A running `tmpi serve` with its own data folder."""

    def __init__(self, *args, data=None, env=None, ready=60, prefix=(), host="127.0.0.1", port=0):
        owns_data, self.prefix, self.listen = data is None, list(prefix), f"{host}:{port}"
        self.data = Path(data or tempfile.mkdtemp(prefix="tmpi-load-"))
        self.log = open(self.data.parent / (self.data.name + ".log"), "a")
        self.args, self.env = args, {**os.environ, "RUST_LOG": "warn", **(env or {})}
        if owns_data:
            atexit.register(self.remove)
        self.start(ready)

    def start(self, ready=60):
        command = [*self.prefix, PROGRAM, "serve", "--addr", self.listen, "--data", str(self.data / "data"), *self.args]
        began = time.monotonic()
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=self.log, env=self.env, text=True)
        line = self.process.stdout.readline().strip()
        self.scheme, _, authority = line.partition("://")
        if self.scheme not in ("http", "https"):
            raise SystemExit(f"the server did not start: see {self.log.name}")
        host, port = authority.rsplit(":", 1)
        self.address = (host, int(port))
        while self.get("/healthz", timeout=ready)[0] != 200:
            time.sleep(0.01)
        self.started_in = time.monotonic() - began

    def connect(self, timeout=60):
        if self.scheme == "https":
            # a self-signed certificate
            return http.client.HTTPSConnection(*self.address, timeout=timeout, context=ssl._create_unverified_context())
        return http.client.HTTPConnection(*self.address, timeout=timeout)

    def request(self, method, path, body=None, headers=None, timeout=120):
        """Returns status, headers and body; status 0 without a response."""
        connection = self.connect(timeout)
        try:
            try:
                connection.request(method, path, body, headers or {})
            except (BrokenPipeError, ConnectionResetError):
                # the server may respond before it has read the whole body
                pass
            response = connection.getresponse()
            return response.status, {k.lower(): v for k, v in response.getheaders()}, response.read()
        except (OSError, http.client.HTTPException) as error:
            return 0, {}, str(error).encode()
        finally:
            connection.close()

    def get(self, path, timeout=120):
        return self.request("GET", path, timeout=timeout)

    def state(self, photo):
        status, _, body = self.get(f"/v1/photos/{photo}")
        return json.loads(body) if status == 200 else {"state": f"status {status}"}

    def upload(self, photo, depth=None, query="", timeout=120, **options):
        """Uploads a photo; returns status and JSON of the response."""
        if depth is None and not options:
            status, _, body = self.request("POST", "/v1/photos" + query, photo, timeout=timeout)
        else:
            parts = {"photo": photo, **({"depth": depth} if depth else {}), **{k: str(v).encode() for k, v in options.items()}}
            content_type, body = multipart(parts)
            status, _, body = self.request("POST", "/v1/photos" + query, body, {"content-type": content_type}, timeout)
        try:
            return status, json.loads(body)
        except ValueError:
            return status, {"detail": body[:200].decode(errors="replace")}

    def wait(self, photo, seconds=600, wanted=("done", "failed", "damaged")):
        deadline = time.monotonic() + seconds
        while True:
            state = self.state(photo)
            if state["state"] in wanted or time.monotonic() > deadline:
                return state
            time.sleep(0.02)

    def metric(self, name):
        for line in self.get("/metrics")[2].decode().splitlines():
            if line.startswith(name + " "):
                return float(line.split()[1])
        return 0.0

    def peak_mib(self):
        """Peak resident memory of the server, and of the largest process that makes photos."""
        server = status_kib(self.process.pid, "VmHWM") / 1024
        makers = [status_kib(child, "VmHWM") / 1024 for child in children(self.process.pid)]
        return server, max(makers, default=0.0)

    def resident_mib(self):
        return status_kib(self.process.pid, "VmRSS") / 1024

    def stop(self):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(60)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()

    def kill(self):
        self.process.kill()
        self.process.wait()

    def remove(self):
        self.stop()
        shutil.rmtree(self.data, ignore_errors=True)
        Path(self.log.name).unlink(missing_ok=True)


def multipart(parts):
    """Returns content type and body of a form."""
    boundary, body = "a-boundary-that-no-part-contains", b""
    for name, value in parts.items():
        body += f'--{boundary}\r\ncontent-disposition: form-data; name="{name}"; filename="f"\r\n\r\n'.encode() + value + b"\r\n"
    return f"multipart/form-data; boundary={boundary}", body + f"--{boundary}--\r\n".encode()


class Watch:
    """Measures latency of another client that sends light requests, and peak memory, while a script loads the server."""

    def __init__(self, server, path="/healthz", every=0.05):
        self.server, self.path, self.every = server, path, every
        self.times, self.failed, self.peak, self.maker_peak = [], 0, 0.0, 0.0
        self.running = True
        self.thread = threading.Thread(target=self.run, daemon=True)

    def run(self):
        while self.running:
            began = time.monotonic()
            status = self.server.get(self.path, timeout=20)[0]
            self.times.append(time.monotonic() - began)
            self.failed += status != 200
            server, maker = self.server.peak_mib()
            self.peak, self.maker_peak = max(self.peak, server), max(self.maker_peak, maker)
            time.sleep(self.every)

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.running = False
        self.thread.join()

    def row(self):
        times = sorted(self.times) or [0.0]
        return {
            "others median": f"{times[len(times) // 2] * 1e3:.0f} ms",
            "worst": f"{times[-1] * 1e3:.0f} ms",
            "not 200": f"{self.failed} of {len(self.times)}",
            "server": f"{self.peak:.0f} MiB",
            "maker": f"{self.maker_peak:.0f} MiB",
        }


class Table:
    """Prints rows of a Markdown table as they arrive."""

    def __init__(self, *columns):
        self.columns = columns
        print("| " + " | ".join(columns) + " |\n|" + " --- |" * len(columns), flush=True)

    def row(self, *cells, **named):
        cells = [str(c) for c in cells] + [str(named.get(c, "")) for c in self.columns[len(cells):]]
        print("| " + " | ".join(cells) + " |", flush=True)


failures = []


def check(ok, what):
    """Records a failed check; `finish` reports it."""
    if not ok:
        failures.append(what)
        print(f"**failed: {what}**", flush=True)
    return ok


def skip(what, reason):
    """Prints that a part is left out, and appends it to the list of skipped tests that TMPI_SKIPPED names."""
    print(f"{what}: skipped: {reason}", flush=True)
    if os.environ.get("TMPI_SKIPPED"):
        with open(os.environ["TMPI_SKIPPED"], "a") as skipped:
            skipped.write(f"other\ttests/load/{Path(sys.argv[0]).name}: {what}\t{reason}\n")


def finish():
    """Exits with status 1 if a check failed."""
    print(f"\n{len(failures)} checks failed" if failures else "\nall checks passed")
    sys.exit(1 if failures else 0)


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width, height, channels, rows, extra=b""):
    """Encodes rows of bytes as an 8-bit PNG, grey (1) or RGB (3); `extra`: chunks before the pixels."""
    compressor, body = zlib.compressobj(1), []
    for row in rows:
        body.append(compressor.compress(b"\0" + row))
    body.append(compressor.flush())
    head = struct.pack(">IIBBBBB", width, height, 8, {1: 0, 3: 2}[channels], 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + extra + chunk(b"IDAT", b"".join(body)) + chunk(b"IEND", b"")


def size_of(megapixels):
    """Width and height at 4:3."""
    width = int((megapixels * 1e6 * 4 / 3) ** 0.5)
    return width, int(megapixels * 1e6 / width)


def noise(megapixels, channels=3, levels=2):
    """Random pixels."""
    width, height = size_of(megapixels)
    table = bytes((i % levels) * (255 // max(1, levels - 1)) for i in range(256))
    return png(width, height, channels, (os.urandom(width * channels).translate(table) for _ in range(height)))


def smooth(megapixels, channels=3, seed=0):
    """A ramp to the right; each seed gives another picture."""
    width, height = size_of(megapixels)
    row = bytes((x * 255 // width + seed) % 256 for x in range(width) for _ in range(channels))
    return png(width, height, channels, (row for _ in range(height)))


def small(seed, width=480, height=360):
    """A picture with edges; each seed gives another picture."""
    rows = [
        bytes(v for x in range(width) for v in (40 if (x // 60 + y // 45 + seed) % 2 else 200, x * 255 // width, (y + 7 * seed) % 256))
        for y in range(height)
    ]
    # the other rows repeat after 256 seeds
    rows[0] = seed.to_bytes(3, "big") + rows[0][3:]
    return png(width, height, 3, rows)


def depth_map(width=80, height=60):
    """A depth map with two values; the server then needs no network to estimate depth."""
    return png(width, height, 1, (bytes(64 if x < width // 2 else 192 for x in range(width)) for _ in range(height)))


def send_raw(server, request, timeout=20):
    """Sends bytes and returns the open socket."""
    connection = socket.create_connection(server.address, timeout)
    connection.sendall(request)
    return connection


def blob_files(server, photo, part):
    """Files of one part of a photo in the blob store."""
    return list((server.data / "data/blobs" / photo[:2]).glob(f"{photo}-{part}-*"))


def duplicate_photo(server, photo, ids):
    """Adds rows that share a photo's blobs under other ids; the server must be stopped."""
    with contextlib.closing(sqlite3.connect(server.data / "data/library.db")) as database, database:
        columns = ", ".join(row[1] for row in database.execute("PRAGMA table_info(photos)") if row[1] not in ("id", "accepted_at", "listed_at"))
        insert = f"INSERT INTO photos (id, accepted_at, listed_at, {columns}) SELECT ?, ?, ?, {columns} FROM photos WHERE id = ?"
        database.executemany(insert, ((other, n, n, photo) for n, other in enumerate(ids)))
