"""Nothing but a launch file and a description: teds-provision is a program of its own."""
