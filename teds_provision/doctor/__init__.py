"""Named checks of this machine, its links and the station, each with its cause and the cure."""
