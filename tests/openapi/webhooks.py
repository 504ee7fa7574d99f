"""A webhook's request held against the reference library of the Standard Webhooks specification."""
import json, queue, threading
from http.server import BaseHTTPRequestHandler, HTTPServer

from common import check


def check_webhooks(server):
    from standardwebhooks import Webhook, WebhookVerificationError

    got = queue.Queue()

    class Receiver(BaseHTTPRequestHandler):
        def do_POST(self):
            body = self.rfile.read(int(self.headers["content-length"]))
            self.send_response(204)
            self.end_headers()
            got.put((dict(self.headers.items()), body.decode()))

        def log_message(self, *_):
            pass

    receiver = HTTPServer(("127.0.0.1", 0), Receiver)
    threading.Thread(target=receiver.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{receiver.server_port}/"
    kind = {"content-type": "application/json"}
    status, _, answer = server.request("POST", "/v1/webhooks", json.dumps({"url": url}), kind)
    check(status == 201, f"a webhook is added: {answer}")
    webhook = json.loads(answer)
    server.request("POST", f"/v1/webhooks/{webhook['id']}/test")
    headers, body = got.get(timeout=60)
    headers = {name.lower(): value for name, value in headers.items()}
    check(Webhook(webhook["secret"]).verify(body, headers)["type"] == "ping", "the reference library accepts a webhook's request")
    try:
        Webhook(webhook["secret"]).verify(body + " ", headers)
        check(False, "the reference library refuses another body")
    except WebhookVerificationError:
        pass
    server.request("DELETE", f"/v1/webhooks/{webhook['id']}")
    receiver.shutdown()
    print("webhooks: accepted", flush=True)
