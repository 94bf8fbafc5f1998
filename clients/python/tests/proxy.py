"""A TCP proxy that loses answers: what is sent arrives, and the connection ends when the answer comes back."""

from __future__ import annotations

import socket
import threading


class LossyProxy:
    """Forwards connections to `target`, HOST:PORT. `lose(n)` ends the connections of the next n answers."""

    def __init__(self, target: str) -> None:
        host, port = target.rsplit(":", 1)
        self._target = (host, int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        self._lock = threading.Lock()
        self._to_lose = 0
        self.lost = 0
        threading.Thread(target=self._accept, daemon=True).start()

    def lose(self, answers: int) -> None:
        with self._lock:
            self._to_lose = answers

    def _loses(self) -> bool:
        with self._lock:
            lose = self._to_lose > 0
            self._to_lose -= lose
            self.lost += lose
            return lose

    def _accept(self) -> None:
        while True:
            try:
                caller, _ = self._listener.accept()
            except OSError:
                return
            server = socket.create_connection(self._target)
            asked = threading.Event()
            threading.Thread(target=self._forward, args=(caller, server, asked, False), daemon=True).start()
            threading.Thread(target=self._forward, args=(server, caller, asked, True), daemon=True).start()

    def _forward(self, source: socket.socket, sink: socket.socket, asked: threading.Event, back: bool) -> None:
        try:
            while data := source.recv(65536):
                if not back:
                    if data.startswith(b"PRI * HTTP/2"):
                        # The server greets before it answers; what it sends first is no answer.
                        asked.clear()
                    # Requests are longer than the frames without content of HTTP/2.
                    elif len(data) > 64:
                        asked.set()
                elif asked.is_set() and len(data) > 40 and self._loses():
                    break
                sink.sendall(data)
        except OSError:
            pass
        for end in (source, sink):
            try:
                end.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass

    def close(self) -> None:
        self._listener.close()
