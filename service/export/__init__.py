"""What leaves Sprung for other tools: tables of histories, bundles of alarms."""
