"""An S3 server on this machine (moto), which answers every n-th request with 503 where that is asked for."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any


@dataclass
class Server:
    """Where it is, and the requests that it got and refused."""

    port: int
    fail_each: int = 0
    requests: list[str] = field(default_factory=list)
    refused: int = 0

    def url(self, path: str) -> str:
        """Address of a path in its bucket, for pyarrow."""
        options = "region=us-east-1&scheme=http&allow_bucket_creation=true"
        return f"s3://testing:testing@bucket/{path}?{options}&endpoint_override=127.0.0.1:{self.port}"


@contextmanager
def s3_server() -> Iterator[Server]:
    """The server, with an empty bucket."""
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import WSGIRequestHandler, make_server

    class Quiet(WSGIRequestHandler):
        def log(self, type: str, message: str, *args: Any) -> None: ...

    s3 = DomainDispatcherApplication(create_backend_app)

    def app(environ: dict[str, Any], start: Any) -> Any:
        server.requests.append(f"{environ['REQUEST_METHOD']} {environ['PATH_INFO']}?{environ['QUERY_STRING']}")
        if server.fail_each and len(server.requests) % server.fail_each == 0:
            server.refused += 1
            environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
            start("503 Service Unavailable", [("Content-Type", "text/plain")])
            return [b"busy"]
        return s3(environ, start)

    running = make_server("127.0.0.1", 0, app, threaded=True, request_handler=Quiet)
    server = Server(running.server_port)
    thread = threading.Thread(target=running.serve_forever, daemon=True)
    thread.start()
    try:
        from pyarrow.fs import FileSystem

        system, path = FileSystem.from_uri(server.url("x"))
        system.create_dir(path.split("/")[0])
        yield server
    finally:
        running.shutdown()
        thread.join(10.0)
        running.server_close()
