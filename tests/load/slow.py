#!/usr/bin/env python3
"""Slow clients: a steady upload, readers, headers; then views of many large photos at once."""
import argparse, socket, threading, time
from common import Server, Table, Watch, check, depth_map, duplicate_photo, finish, noise, send_raw, smooth


def upload_slowly(server, photo, rate):
    """Uploads a photo at `rate` bytes per second; returns the status."""
    head = f"POST /v1/photos?max-size=320 HTTP/1.1\r\nhost: localhost\r\nprefer: wait=25\r\ncontent-length: {len(photo)}\r\n\r\n"
    connection = send_raw(server, head.encode(), 120)
    piece = max(1, rate // 10)
    for at in range(0, len(photo), piece):
        connection.sendall(photo[at : at + piece])
        time.sleep(0.1)
    return int(connection.recv(4096).split(b" ")[1])


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--full", action="store_true")
    full = args.parse_args().full
    table = Table("clients", "outcome", "after", "others median", "worst", "not 200", "server", "maker")

    server = Server("--set", "limits.connections=4096", "--set", "limits.connections-per-address=4096")
    photo = noise(18 if full else 1.5)
    rate = (64 << 10) if full else (512 << 10)
    with Watch(server) as watch:
        began = time.monotonic()
        status = upload_slowly(server, photo, rate)
        took = time.monotonic() - began
    check(status in (201, 202), f"the server accepts a slow upload: {status}")
    check(took > 0.9 * len(photo) / rate, "the upload was slow")
    table.row(f"upload of {len(photo) / 1e6:.1f} MB at {rate >> 10} KiB/s", status, f"{took:.0f} s", **watch.row())

    # readers download a large file
    status, answer = server.upload(noise(3), depth_map())
    check(server.wait(answer["id"])["state"] == "done", "the photo is made")
    path = f"/v1/photos/{answer['id']}/export?format=zip"
    length = len(server.get(path)[2])
    count = 1024 if full else 128
    readers = []
    with Watch(server, every=0.2) as watch:
        began = time.monotonic()
        for _ in range(count):
            connection = socket.socket()
            # a small buffer, else the kernel would take the whole file
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            connection.settimeout(20)
            connection.connect(server.address)
            connection.sendall(f"GET {path} HTTP/1.1\r\nhost: localhost\r\n\r\n".encode())
            readers.append(connection)
        end_at = began + (60 if full else 30)
        while time.monotonic() < end_at:
            for connection in readers:
                try:
                    connection.setblocking(False)
                    connection.recv(10)
                except OSError:
                    pass
            time.sleep(1)
        # the request for the metric is a connection too
        left = server.metric("tmpi_connections") - 1
    check(watch.failed == 0, "/healthz responds while many clients read slowly")
    check(left < count / 10, f"the server disconnects slow readers: {left:.0f} remain")
    check(watch.peak < 768, f"slow readers take no memory: {watch.peak:.0f} MiB")
    table.row(f"{count} readers of 10 bytes/s, {length / 1e6:.0f} MB each", f"{count - left:.0f} disconnected", f"{time.monotonic() - began:.0f} s", **watch.row())
    for connection in readers:
        connection.close()

    with Watch(server, every=0.2) as watch:
        began = time.monotonic()
        loris = [send_raw(server, b"GET / HTTP/1.1\r\nhost: local") for _ in range(100)]
        open_, end_at = list(loris), began + 25
        while open_ and time.monotonic() < end_at:
            for connection in list(open_):
                try:
                    connection.setblocking(True)
                    connection.settimeout(0.01)
                    connection.sendall(b"h")
                    if connection.recv(100) == b"":
                        raise ConnectionResetError
                except TimeoutError:
                    pass
                except OSError:
                    open_.remove(connection)
            time.sleep(0.5)
        took = time.monotonic() - began
    check(not open_, f"the server disconnects slow headers: {len(open_)} remain after {took:.0f} s")
    table.row("100 slow headers", f"{100 - len(open_)} disconnected", f"{took:.0f} s", **watch.row())
    server.remove()

    # views of many large photos at once: one photo under many ids
    count, megapixels = (66, 49.9) if full else (66, 2)
    server = Server("--set", "limits.job-timeout=1800")
    status, answer = server.upload(smooth(megapixels), depth_map(), timeout=300)
    state = server.wait(answer["id"], 3600)
    check(state["state"] == "done", f"the photo is made: {state}")
    server.stop()
    ids = [f"{n:032x}" for n in range(1, count + 1)]
    duplicate_photo(server, answer["id"], ids)
    server.start()
    before = server.resident_mib()
    answers = {}

    def get_view(photo):
        status = server.get(f"/v1/photos/{photo}/view?w=320", timeout=600)[0]
        answers[status] = answers.get(status, 0) + 1

    with Watch(server) as watch:
        began = time.monotonic()
        threads = [threading.Thread(target=get_view, args=(photo,)) for photo in ids]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        took = time.monotonic() - began
    check(set(answers) <= {200, 503}, f"the server draws or refuses views: {answers}")
    # the initial memory, cached scenes, scenes in use, and small caches
    bound = before + 256 + 1024 + 200 + 300
    check(watch.peak < bound, f"memory stays within {bound:.0f} MiB: {watch.peak:.0f}")
    check(watch.failed == 0, "/healthz responds during the views")
    table.row(f"views of {count} photos of {megapixels} MP at once", answers, f"{took:.0f} s", **watch.row())
    finish()


main()
