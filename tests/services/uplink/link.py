"""A TCP relay on loopback as a link between two hosts that a test can cut."""

import contextlib
import selectors
import socket
import threading
import time

from tests.conftest import free_port


class CuttableLink:
    """Forwards connections to `port` to `target_port`.

    While it is cut nothing is forwarded and connections stay open, as with a radio out of range.
    """

    def __init__(self, target_port, rate_bytes_s=None):
        self._target, self._rate = target_port, rate_bytes_s
        self.port = free_port()
        self.cut = False
        self.carried = 0
        self._stop = False
        self._listener = socket.create_server(("127.0.0.1", self.port))
        self._listener.settimeout(0.1)
        self._threads = [threading.Thread(target=self._accept, daemon=True)]

    def __enter__(self):
        self._threads[0].start()
        return self

    def __exit__(self, *exception):
        self._stop = True
        for thread in self._threads:
            thread.join(5)
        self._listener.close()

    def _accept(self):
        while not self._stop:
            try:
                near, _ = self._listener.accept()
            except TimeoutError:
                continue
            thread = threading.Thread(target=self._carry, args=(near,), daemon=True)
            self._threads.append(thread)
            thread.start()

    def _carry(self, near):
        while self.cut and not self._stop:
            time.sleep(0.02)
        with near, contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self._target)) as far:
            selector = selectors.DefaultSelector()
            selector.register(near, selectors.EVENT_READ, far)
            selector.register(far, selectors.EVENT_READ, near)
            while not self._stop:
                if self.cut:
                    time.sleep(0.02)
                    continue
                for key, _ in selector.select(0.1):
                    data = key.fileobj.recv(16384)
                    if not data:
                        return
                    key.data.sendall(data)
                    self.carried += len(data)
                    if self._rate:
                        time.sleep(len(data) / self._rate)
