#!/usr/bin/env python3
"""Requests a second and latency of a photo's container beside nginx that serves the same file, in turns; without TLS and with it. Needs wrk, nginx and openssl."""
import argparse, os, re, shutil, signal, statistics, subprocess, tempfile, time
from pathlib import Path
from common import ROOT, Server, Table, check, end
from engines import free_port, listening

NGINX = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")
CONFIG = """
worker_processes auto; pid {folder}/pid; error_log {folder}/error.log; worker_rlimit_nofile 8192; user {user};
events {{ worker_connections 4096; }}
http {{
  access_log off; sendfile on; tcp_nopush on; keepalive_requests 1000000000; open_file_cache max=100;
  client_body_temp_path {folder}/a; proxy_temp_path {folder}/b; fastcgi_temp_path {folder}/c; uwsgi_temp_path {folder}/d; scgi_temp_path {folder}/e;
  server {{ listen 127.0.0.1:{plain}; root {folder}/files; }}
  server {{ listen 127.0.0.1:{tls} ssl; ssl_certificate {folder}/cert.pem; ssl_certificate_key {folder}/key.pem; root {folder}/files; }}
}}
"""


class Nginx:
    def __init__(self, folder, body):
        self.plain, self.tls = free_port(), free_port()
        (folder / "files").mkdir()
        (folder / "files" / "atlas").write_bytes(body)
        (folder / "nginx.conf").write_text(CONFIG.format(folder=folder, plain=self.plain, tls=self.tls, user="root" if os.geteuid() == 0 else "nobody"))
        self.process = subprocess.Popen([NGINX, "-c", folder / "nginx.conf", "-g", "daemon off;"], stderr=subprocess.DEVNULL)
        listening(self.plain)


def load(url, connections, seconds):
    """Requests a second, p99 in ms, errors."""
    out = subprocess.run(["wrk", "--latency", "-t2" if connections > 1 else "-t1", f"-c{connections}", f"-d{seconds}s", url], capture_output=True, text=True).stdout
    rate = float(re.search(r"Requests/sec:\s+([\d.]+)", out)[1])
    number, unit = re.search(r"99%\s+([\d.]+)(us|ms|s)", out).groups()
    errors = re.findall(r"Non-2xx[^\n]*|Socket errors[^\n]*", out)
    return rate, float(number) * {"us": 1e-3, "ms": 1, "s": 1e3}[unit], "; ".join(errors)


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true")
    full = args.parse_args().full
    if not (NGINX and shutil.which("wrk") and shutil.which("openssl")):
        raise SystemExit("needs nginx, wrk and openssl")
    turns, seconds = (5, 10) if full else (2, 3)
    folder = Path(tempfile.mkdtemp(prefix="tmpi-throughput-"))
    subprocess.run(["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1",
                    "-keyout", folder / "key.pem", "-out", folder / "cert.pem"], check=True, capture_output=True)
    plenty = ("--connections", "4096", "--access", "open")
    plain = Server(*plenty)
    status, answer = plain.upload((ROOT / "docs/sample.jpg").read_bytes())
    check(status in (201, 202) and plain.wait(answer["id"])["state"] == "done", "the photo is made")
    path = f"/v1/photos/{answer['id']}/atlas"
    body = plain.get(path)[2]
    plain.stop()
    # the same data, once more for each
    plain.start()
    copy = Path(tempfile.mkdtemp(prefix="tmpi-throughput-"))
    shutil.copytree(plain.data / "data", copy / "data")
    secure = Server(*plenty, "--tls-cert", str(folder / "cert.pem"), "--tls-key", str(folder / "key.pem"), data=copy)
    nginx = Nginx(folder, body)
    table = Table("", "connections", "tmpi, requests/s", "p99, ms", "nginx, requests/s", "p99, ms", "tmpi / nginx, median of turns", "lowest", "errors")
    for what, ours, theirs in (
        ("http", f"http://127.0.0.1:{plain.address[1]}{path}", f"http://127.0.0.1:{nginx.plain}/atlas"),
        ("https", f"https://127.0.0.1:{secure.address[1]}{path}", f"https://127.0.0.1:{nginx.tls}/atlas"),
    ):
        for connections in (1, 64, 512):
            pairs = []
            for turn in range(turns):
                order = [ours, theirs] if turn % 2 == 0 else [theirs, ours]
                got = {url: load(url, connections, seconds) for url in order}
                pairs.append((got[ours], got[theirs]))
            middle = lambda side, part: statistics.median(pair[side][part] for pair in pairs)
            shares = [a[0] / b[0] for a, b in pairs]
            errors = "; ".join(sorted({p[2] for pair in pairs for p in pair if p[2]})) or "none"
            check(errors == "none", f"{what}, {connections}: {errors}")
            if what == "http":
                check(statistics.median(shares) >= 0.9, f"{what}, {connections} connections: {statistics.median(shares):.2f} of nginx")
            table.row(what, connections, f"{middle(0, 0):.0f}", f"{middle(0, 1):.2f}", f"{middle(1, 0):.0f}", f"{middle(1, 1):.2f}", f"{statistics.median(shares):.2f}", f"{min(shares):.2f}", errors)
    print(f"container of {len(body)} bytes")
    nginx.process.send_signal(signal.SIGTERM)
    for server in (plain, secure):
        server.remove()
    for left in (folder, copy):
        shutil.rmtree(left, ignore_errors=True)
    end()


main()
