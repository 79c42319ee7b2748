"""A real HTTP server that receives the events of a webhook, for tests."""

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class Receiver:
    """Records requests; `statuses` are answered first, one per request, then 204."""

    def __init__(self, statuses=(), headers=()):
        self.requests, self.events = [], []  # (headers, body), and the bodies that were accepted
        self._statuses, self._headers = list(statuses), dict(headers)
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self):
                body = self.rfile.read(int(self.headers["Content-Length"]))
                outer.requests.append((dict(self.headers), body))
                status = outer._statuses.pop(0) if outer._statuses else 204
                if 200 <= status < 300:
                    outer.events.append(json.loads(body))
                self.send_response(status)
                for name, value in outer._headers.items():
                    self.send_header(name, value)
                self.end_headers()

            def log_message(self, *_):
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.port = self._server.server_address[1]
        self.address = f"http://127.0.0.1:{self.port}/hook?key=SECRET"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self._server.shutdown()
        self._server.server_close()
