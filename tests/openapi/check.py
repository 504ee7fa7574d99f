#!/usr/bin/env python3
"""The descriptions of the HTTP interface and of the operators' own held against two linters, and the server against them (schemathesis).

    npm install --no-audit --no-fund && python3 -m venv venv && venv/bin/pip install -r requirements.txt
    cargo build --release && venv/bin/python check.py

Starts its server itself; `TMPI` names another program than `target/release/tmpi`. A photo has to be made for it, so ONNX Runtime must be found:
`ORT_DYLIB_PATH` names its library. `--only lint` takes seconds and needs neither schemathesis nor that."""
import argparse, shutil, subprocess, sys, tempfile, urllib.request
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "load"))
from common import ROOT, Server, check, finish
from services import free_port
from webhooks import check_webhooks

# of sockets and of streams that do not end nothing comes that could be judged
ENDLESS = "(publish|subscribe|events)$"

# What a description cannot say: that a parameter goes with another one (`view`, `export`, `exports`), lies within this very photo (`region`), names
# a photo that is there (`after`), or is a public address (`url`). Of faults of the server hooks.py tells 501, which a description may have.
RULES = f"""
request-timeout = 120
hooks = "{HERE / 'hooks.py'}"
[checks.not_a_server_error]
enabled = false
[checks.positive_data_acceptance]
expected-statuses = ["2xx", "3xx", "401", "403", "404", "409", "412", "413", "415", "422", "429", "503"]
[checks.negative_data_rejection]
expected-statuses = ["400", "401", "403", "404", "405", "406", "409", "412", "413", "415", "422", "428", "429", "501", "503"]
""" + "".join(f"""
[[operations]]
include-path = "{path}"
checks.{name}.enabled = false
""" for path, name in [
    ("/v1/photos/{id}/atlas", "positive_data_acceptance"),
    ("/v1/photos/{id}/export", "positive_data_acceptance"),
    ("/v1/photos/{id}/exports", "positive_data_acceptance"),
    ("/v1/photos/{id}/view", "positive_data_acceptance"),
]) + """
[[operations]]
include-path = "/v1/webhooks"
checks.positive_data_acceptance.enabled = false
[[operations]]
include-path = "/v1/webhooks/{id}"
checks.positive_data_acceptance.enabled = false
[[operations]]
include-path = "/v1/photos"
include-method = "GET"
checks.positive_data_acceptance.enabled = false
[[operations]]
include-path = "/v1/photos"
include-method = "POST"
checks.positive_data_acceptance.enabled = false
"""


def lint(document):
    for name, command in (
        ("redocly", ["redocly", "lint", "--max-problems", "1000", "--config", HERE / "redocly.yaml", document]),
        ("spectral", ["spectral", "lint", "--fail-severity", "warn", "--ruleset", HERE / "spectral.yaml", document]),
    ):
        done = subprocess.run(["npx", "--no-install", *command], cwd=HERE, capture_output=True, text=True)
        check(done.returncode == 0, f"{name} accepts {document.name}:\n{done.stdout}{done.stderr}")
        print(f"{name}, {document.name}: {'accepted' if done.returncode == 0 else 'refused'}", flush=True)


def play(document, address, server, name, config, *arguments):
    """Requests that follow the description and such that do not."""
    folder = document.parent
    file = folder / f"{name}.toml"
    file.write_text(RULES + config)
    url = "http://{}:{}".format(*address)
    program = shutil.which("schemathesis") or str(Path(sys.executable).parent / "schemathesis")
    done = subprocess.run([program, "--config-file", file, "run", document, "--url", url, "--exclude-path-regex", ENDLESS, "--seed", "1",
                           "--continue-on-failure", "--generation-database", "none", *arguments], cwd=folder, capture_output=True, text=True)
    (folder / f"{name}.log").write_text(done.stdout + done.stderr)
    summary = done.stdout[done.stdout.rfind("SUMMARY"):] if "SUMMARY" in done.stdout else done.stderr
    print(f"## {name}\n{summary if done.returncode == 0 else done.stdout[-20000:]}", flush=True)
    check(done.returncode == 0, f"schemathesis, {name}")
    check(server.get("/healthz")[0] == 200, "the server is alive")


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true", help="200 requests of each kind, not 20")
    args.add_argument("--only", choices=["lint", "play"])
    args = args.parse_args()
    many = "200" if args.full else "20"
    door = ("127.0.0.1", free_port())
    server = Server("--private-webhooks", "--set", "limits.queue=100000", "--admin", "{}:{}".format(*door))
    with tempfile.TemporaryDirectory(prefix="tmpi-openapi-") as folder:
        public, admin = Path(folder) / "openapi.json", Path(folder) / "admin.json"
        public.write_bytes(server.get("/openapi.json")[2])
        admin.write_bytes(urllib.request.urlopen("http://{}:{}/openapi.json".format(*door), timeout=60).read())
        if args.only != "play":
            lint(public)
            lint(admin)
        if args.only != "lint":
            check_webhooks(server)
            _, answer = server.upload((ROOT / "docs/sample.jpg").read_bytes())
            check(server.wait(answer["id"])["state"] == "done", "a photo is made")
            there = f'[parameters]\n"path.id" = "{answer["id"]}"\n'
            play(public, server.address, server, "a photo that is there", there, "-n", many, "--include-path-regex", "[{]id[}]", "--exclude-method", "DELETE")
            play(public, server.address, server, "everything else", "", "-n", many)
            # that one tells the server to leave
            play(admin, door, server, "operators", "", "-n", many, "--exclude-path", "/drain")
    finish()


main()
