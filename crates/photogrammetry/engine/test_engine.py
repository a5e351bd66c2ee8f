"""What the engine does beside COLMAP: pairs of photos, and the alignment with GNSS."""

import unittest

import engine
import numpy as np


class Pairs(unittest.TestCase):
    def test_few_photos_are_matched_all_with_all(self):
        images = [{"enu_m": None}] * 5
        self.assertEqual(len(engine.pairs_of(images)), 10)

    def test_many_photos_are_matched_with_their_neighbours(self):
        images = [{"enu_m": [10.0 * index, 0.0, 50.0]} for index in range(100)]
        images[40] = {"enu_m": None}
        pairs = engine.pairs_of(images)
        self.assertIn((10, 11), pairs)
        self.assertNotIn((10, 60), pairs)
        self.assertEqual(sum(40 in pair for pair in pairs), 99)
        self.assertEqual(len(pairs), len(set(pairs)))
        self.assertTrue(all(a < b for a, b in pairs))


class Alignment(unittest.TestCase):
    def test_positions_far_off_do_not_turn_the_plant(self):
        rng = np.random.default_rng(5)
        source = rng.uniform(-1, 1, (20, 3)) * [10, 10, 1]
        angle = 0.7
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        target = 3.0 * source @ turn.T + [100, -50, 60]
        target[[3, 11]] += [[40, 0, 0], [0, -80, 10]]
        scale, rotation, shift = engine.robust_similarity(source, target)
        self.assertAlmostEqual(scale, 3.0, places=6)
        np.testing.assert_allclose(rotation, turn, atol=1e-6)
        np.testing.assert_allclose(shift, [100, -50, 60], atol=1e-5)

    def test_photos_in_a_line_do_not_place_the_plant(self):
        line = np.array([[index, 2.0 * index, 0.0] for index in range(10)], float)
        self.assertIsNone(engine.robust_similarity(line, line))
        self.assertIsNone(engine.robust_similarity(line[:2], line[:2]))


if __name__ == "__main__":
    unittest.main()
