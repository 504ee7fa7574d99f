"""What the check of schemathesis for faults of the server cannot tell: 501 says that this server lacks something, and a description may say so."""
import schemathesis


@schemathesis.check
def no_fault_of_the_server(ctx, response, case):
    status = response.status_code
    described = str(status) in case.operation.definition.raw.get("responses", {})
    if status >= 500 and not (status == 501 and described):
        raise AssertionError(f"{status} is a fault of the server")
