"""The first room of Montezuma's Revenge."""
