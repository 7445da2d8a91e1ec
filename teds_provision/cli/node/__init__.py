"""Commands of the virtual transducer."""
