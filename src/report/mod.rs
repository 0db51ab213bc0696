//! Colour maps, plots, and what a run leaves behind.
