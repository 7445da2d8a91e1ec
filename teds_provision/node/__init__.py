"""The virtual transducer: flash in a file, TIM server, both links."""
