"""Shapes that several rooms share, each defined once; the room is below all others and imports none.

===============  =====================================================================================
module           what it holds
===============  =====================================================================================
``metadata``     facts beside the type of a field: of its JSON schema, of its option on the command line
``measurement``  a measurement's settings: options, request and answer of the API, the store's columns
``node``         a node as the store knows it: ``nodes --json``, and what the API's node has besides its link
``problem``      an error as JSON: of --json, of the API, in its description, and read back by ``client``
``verdict``      the checks of a datasheet, their one verdict, and how it is known
===============  =====================================================================================
"""
