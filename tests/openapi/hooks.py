"""What the check of schemathesis for faults of the server cannot tell: 501 says that this server lacks something, and a description may say so."""
import schemathesis


@schemathesis.check
def no_fault_of_the_server(ctx, response, case):
    status = response.status_code
    described = str(status) in case.operation.definition.raw.get("responses", {})
    if status >= 500 and not (status == 501 and described):
        raise AssertionError(f"{status} is a fault of the server")


@schemathesis.serializer("application/partial-upload")
def part(ctx, value):
    """A part of an upload is its bytes."""
    return value if isinstance(value, bytes) else getattr(value, "data", None) or str(value).encode()
