"""The steps from tap to flash (Figures 3 and 4 of the papers), and handover."""
