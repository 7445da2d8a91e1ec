"""Published vectors of the profile, and the program that makes them."""
