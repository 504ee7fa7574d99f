#!/usr/bin/env python3
"""Checks docker/ with external tools and prints a line for each check: `passed`, `FAILED` or `skipped` with the reason.

    python3 docker/lint.py             exits with status 1 if a check fails
    python3 docker/lint.py --require   also if a check is skipped

Needs only Python's standard library. Tools come from PATH, or from a variable with their name: PROMTOOL=/opt/prometheus/promtool.
pip install -r docker/requirements.txt installs most of them; promtool is part of Prometheus. Without docker compose, COMPOSE_SCHEMA
may name compose-spec.json, the schema of Compose files (pip install jsonschema pyyaml). The names of all metrics come from the program:
target/release/tmpi, or the path in TMPI."""
import argparse, json, os, re, shutil, subprocess, sys, tempfile, urllib.request
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
# variables that compositions and configurations need; none is a real secret
ENVIRONMENT = {
    "TMPI_HOST": "photos.example.org",
}
# suffixes of counters and histograms
ENDS = ("_total", "_bucket", "_sum", "_count", "_created")
SECONDS = 120


class Skipped(Exception):
    pass


class Failed(Exception):
    pass


def tool(name):
    """Path of a tool."""
    named = os.environ.get(re.sub(r"\W", "_", name).upper())
    # tools that pip installed beside this Python
    beside = str(Path(sys.executable).parent)
    found = named or shutil.which(name) or shutil.which(name, path=beside)
    if not found:
        raise Skipped(f"there is no {name}")
    return found


def run(*command, cwd=HERE):
    """Output of a tool; fails if the tool does."""
    try:
        done = subprocess.run([str(c) for c in command], cwd=cwd, env={**os.environ, **ENVIRONMENT}, capture_output=True, text=True, timeout=SECONDS)
    except OSError as error:
        raise Failed(f"{command[0]}: {error.strerror}") from error
    except subprocess.TimeoutExpired as error:
        raise Failed(f"{command[0]}: no result after {SECONDS} s") from error
    if done.returncode:
        raise Failed(f"{Path(command[0]).name} {' '.join(map(str, command[1:]))}\n{done.stdout}{done.stderr}".strip())
    return done.stdout


def composer():
    """A command that parses Compose files, with or without a daemon."""
    try:
        docker = tool("docker")
        run(docker, "compose", "version")
        return [docker, "compose"]
    except (Skipped, Failed):
        pass
    try:
        return [tool("docker-compose")]
    except Skipped as none:
        raise Skipped("there is neither docker compose nor docker-compose") from none


def compositions():
    try:
        command = composer()
    except Skipped as none:
        return compositions_by_schema(none)
    with tempfile.TemporaryDirectory(prefix="tmpi-check-") as folder:
        # with dummy secrets, because the named files must exist
        copy = Path(folder) / "docker"
        shutil.copytree(HERE, copy, ignore=shutil.ignore_patterns("secrets"))
        (copy / "secrets").mkdir()
        for name in ("live-key", "store.env", "store.json", "database.env"):
            (copy / "secrets" / name).touch()
        for file in sorted(copy.glob("compose*.yaml")):
            run(*command, "--file", file, "config", "--quiet", cwd=copy)


def compositions_by_schema(none):
    """Checks only the syntax, if there is no tool for Compose files."""
    schema = os.environ.get("COMPOSE_SCHEMA")
    if not schema:
        raise Skipped(f"{none}, and COMPOSE_SCHEMA names no compose-spec.json")
    try:
        import jsonschema, yaml
    except ImportError as missing:
        raise Skipped(f"{none}, and Python has no {missing.name}") from missing
    schema = json.loads(Path(schema).read_text())
    validator = jsonschema.validators.validator_for(schema, jsonschema.Draft7Validator)(schema)
    for file in sorted(HERE.glob("compose*.yaml")):
        errors = list(validator.iter_errors(yaml.safe_load(file.read_text())))
        if errors:
            raise Failed("\n".join(f"{file.name}: {'.'.join(map(str, e.absolute_path))}: {e.message}" for e in errors))


def image():
    run(tool("hadolint"), "--failure-threshold", "info", "Dockerfile")


def proxies():
    caddy = tool("caddy")
    for file in sorted((HERE / "caddy").glob("*.Caddyfile")):
        run(caddy, "validate", "--adapter", "caddyfile", "--config", file)
        # prints differences in formatting
        run(caddy, "fmt", "--diff", file)


def alerts():
    promtool = tool("promtool")
    run(promtool, "check", "rules", "alerts.yaml", cwd=HERE / "prometheus")
    run(promtool, "test", "rules", "alerts.test.yaml", cwd=HERE / "prometheus")


def manifests():
    validate = tool("kubernetes-validate")
    for folder in (HERE / "kubernetes", HERE / "kubernetes/cluster"):
        run(validate, "--strict", *(f for f in sorted(folder.glob("*.yaml")) if f.name != "kustomization.yaml"))


def kustomizations():
    try:
        command = [tool("kubectl"), "kustomize"]
    except Skipped:
        command = [tool("kustomize"), "build"]
    validate = tool("kubernetes-validate")
    for folder in (HERE / "kubernetes", HERE / "kubernetes/cluster"):
        whole = run(*command, folder)
        with tempfile.NamedTemporaryFile("w", prefix="tmpi-check-", suffix=".yaml") as file:
            file.write(whole)
            file.flush()
            run(validate, "--strict", file.name)


def unit():
    analyze = tool("systemd-analyze")
    with tempfile.TemporaryDirectory(prefix="tmpi-check-") as folder:
        # the program is not at its installed path
        copy = Path(folder) / "tmpi.service"
        copy.write_text((HERE / "tmpi.service").read_text().replace("/opt/tmpi/tmpi ", "/bin/true "))
        run(analyze, "verify", copy)


def base_names(name):
    """Possible names of a metric in the program, without a suffix that Prometheus adds."""
    return [name, *(name.removesuffix(end) for end in ENDS if name.endswith(end))]


def metrics():
    """Names of a node's metrics, including those of rooms."""
    program = os.environ.get("TMPI", str(ROOT / "target/release/tmpi"))
    if not Path(program).is_file():
        raise Skipped(f"there is no {program}")
    with tempfile.TemporaryDirectory(prefix="tmpi-check-") as folder:
        command = [program, "serve", "--addr", "127.0.0.1:0", "--data", f"{folder}/data"]
        with open(f"{folder}/log", "w") as log:
            server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True)
        try:
            address = server.stdout.readline().strip()
            if not address.startswith("http"):
                raise Failed(f"the server does not start: {Path(folder, 'log').read_text()}")
            text = urllib.request.urlopen(f"{address}/metrics", timeout=30).read().decode()
        finally:
            server.terminate()
            server.wait(SECONDS)
    exported = set(re.findall(r"^# TYPE (\w+)", text, re.MULTILINE))
    if "tmpi_uptime_seconds" not in exported and len(exported) < 20:
        raise Failed(f"few metrics: {sorted(exported)}")
    # the output lacks metrics that have no value yet
    return exported.union(*(re.findall(r'"(tmpi_[a-z_]+)"', file.read_text()) for file in (ROOT / "src").rglob("*.rs")))


def dashboard():
    known = metrics()
    for file in sorted((HERE / "grafana").glob("*.json")):
        board = json.loads(file.read_text())
        queries = [target["expr"] for panel in board["panels"] for target in panel.get("targets", [])]
        named = set(re.findall(r"\btmpi_\w+", " ".join(queries)))
        if not named:
            raise Failed(f"{file.name} has no queries of metrics")
        unknown = sorted(name for name in named if not known.intersection(base_names(name)))
        if unknown:
            raise Failed(f"{file.name}: unknown metrics: {', '.join(unknown)}")


CHECKS = {
    "compositions": compositions,
    "Dockerfile": image,
    "Caddyfiles": proxies,
    "alerts": alerts,
    "Kubernetes manifests": manifests,
    "kustomizations": kustomizations,
    "systemd unit": unit,
    "dashboard metrics": dashboard,
}


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--require", action="store_true", help="a skipped check fails")
    require = arguments.parse_args().require
    bad = False
    for name, check in CHECKS.items():
        try:
            check()
            print(f"{name}: passed", flush=True)
        except Skipped as why:
            print(f"{name}: {'FAILED, ' if require else ''}skipped: {why}", flush=True)
            if "TMPI_SKIPPED" in os.environ:
                with open(os.environ["TMPI_SKIPPED"], "a") as skipped:
                    skipped.write(f"tool\tdocker/lint.py: {name}\t{why}\n")
            bad |= require
        except Failed as why:
            print(f"{name}: FAILED: {why}", flush=True)
            bad = True
    sys.exit(bad)


main()
