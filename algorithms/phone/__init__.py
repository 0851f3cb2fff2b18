"""Pedestrian dead reckoning with a phone: attitude, steps, lengths, headings, fusion with fixes."""
