"""What a virtual transducer measures and acts with: channels, clock, battery."""
