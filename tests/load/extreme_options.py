#!/usr/bin/env python3
"""Tries extreme values of the options on a noisy photo with a noisy depth map: the result is readable, or the server rejects the upload and names the bound."""
import argparse, itertools, time
from common import Server, Table, check, finish, noise


def main():
    args = argparse.ArgumentParser(description=__doc__)
    args.add_argument("--megapixels", type=float)
    args.add_argument("--full", action="store_true")
    args = args.parse_args()
    megapixels = args.megapixels or (12 if args.full else 0.2)
    photo, depth = noise(megapixels), noise(megapixels, 1, 16)
    server = Server("--set", "limits.job-timeout=3600", "--set", "limits.queue=4", "--set", "limits.request-timeout=600")
    table = Table("options", "response", "outcome", "after", "maker", "atlas", "level", "view", "zip")
    corners = [
        dict(tile=tile, planes=planes, view_box=box, max_error=0)
        for tile, planes, box in itertools.product(("8", "16", "64", "1024", "full"), ("auto", "1", "16", "64"), ("0,0,0", "10,10,10"))
    ]
    corners += [dict(quality=q, denoise="off", snap=s, max_error=e) for q, s, e in ((1, "on", 1000), (100, "off", 0))]
    corners += [dict(fov_x=v) for v in (0.001, 179.999)] + [dict(max_size=v) for v in (1, 64)]
    corners += [dict(plane_method=m, planes=64) for m in ("linear", "lloyd", "optimal", "slanted")]
    for options in corners:
        began = time.monotonic()
        name = " ".join(f"{k}={v}" for k, v in options.items())
        status, answer = server.upload(photo, depth, **options)
        if status not in (201, 202):
            names_bound = status in (400, 413) and answer.get("field") and any(c.isdigit() for c in answer.get("detail", ""))
            check(names_bound, f"{name}: {status} {answer.get('detail')}, want 400 or 413 with the bound")
            table.row(name, status, answer.get("detail", "")[:90])
            continue
        state = server.wait(answer["id"], 3600)
        took, maker = time.monotonic() - began, server.peak_mib()[1]
        check(state["state"] == "done", f"{name}: {state['state']} {state.get('problem')}")
        statuses = {}
        if state["state"] == "done":
            for part, path in dict(atlas="atlas", level="atlas?level=1", view="view?w=64", zip="export?format=zip").items():
                statuses[part] = server.get(f"/v1/photos/{answer['id']}/{path}", timeout=600)[0]
                check(statuses[part] == 200, f"{name}: {part} {statuses[part]}")
        server.request("DELETE", f"/v1/photos/{answer['id']}")
        table.row(name, status, state["state"], f"{took:.1f} s", f"{maker:.0f} MiB", *statuses.values())
    finish()


main()
