"""The shapes of the API, each once: members of requests and answers, and the operations.

==============  ========================================================================
module          what it holds
==============  ========================================================================
``bodies``      request bodies, as frozen dataclasses
``answers``     answers, as typed dictionaries
``schema``      from a type to its JSON schema, and from JSON to a value of the type
``operations``  every operation with its body and answer, and the OpenAPI document
==============  ========================================================================

The daemon reads bodies with :func:`schema.read`, `openapi.json` is :func:`operations.document`, and
``teds_provision.client`` is typed with the same answers. Why not FastAPI or msgspec: docs/adr/0021.
"""
