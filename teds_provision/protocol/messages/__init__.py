"""The octets between NCAP and TIM: command and reply frames, Identify."""
