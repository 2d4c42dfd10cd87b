"""Coverage of other views by the mapping frames, and planning of flights that close the gaps."""
