"""The hardware of a virtual transducer: channels, clock, battery."""
