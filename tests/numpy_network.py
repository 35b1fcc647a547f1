"""The layers of the paper's network in NumPy, from its equations."""

import numpy as np


def linear(layer, x):
    bias = 0.0 if layer.bias is None else np.asarray(layer.bias[...], np.float64)
    return x @ np.asarray(layer.kernel[...], np.float64) + bias


def norm(layer, x):
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)
    return x * np.asarray(layer.scale[...]) + np.asarray(layer.bias[...])


def relu(x):
    return np.maximum(x, 0.0)


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x))


def softmax(x):
    weights = np.exp(x - x.max())
    return weights / weights.sum()


def gru(cell, hidden, x):
    c = len(hidden)
    i, h = linear(cell.dense_i, x), linear(cell.dense_h, hidden)
    reset, update = sigmoid(i[:c] + h[:c]), sigmoid(i[c : 2 * c] + h[c : 2 * c])
    return (1.0 - update) * np.tanh(i[2 * c :] + reset * h[2 * c :]) + update * hidden


def attend(net, encoding, path, node):
    """Attention* of a node after a path, with the GRU run over the whole path again."""
    hidden, codes = np.zeros(net.channels), []
    for walked in path:
        hidden = gru(net.gru, hidden, np.asarray(encoding.code[walked]))
        codes.append(hidden)
    codes = np.reshape(codes[-net.max_path :], (-1, net.channels))
    o = np.asarray(encoding.environment[node])
    keys = linear(net.key_environment, o)
    queries = np.vstack([linear(net.query_environment, o), linear(net.query_path, codes)])
    values = np.vstack([linear(net.value_environment, o), linear(net.value_path, codes)])
    weights = softmax(queries @ keys / np.sqrt(net.channels))
    return norm(net.attention_norm, weights @ values + o)


def decode(net, encoding, path, roadmap, nodes, node, neighbor):
    """The guidance value of one edge."""
    x_i, x_j = attend(net, encoding, path, node), attend(net, encoding, [], neighbor)
    first = linear(net.decoder_node, x_i) + linear(net.decoder_difference, x_i - x_j)
    first = first + linear(net.decoder_environment, np.asarray(encoding.environment[node]))
    geometry = None
    if net.geometric_features:
        q, goal = nodes / np.pi, nodes[1] / np.pi
        near, far = np.linalg.norm(q[node] - goal), np.linalg.norm(q[neighbor] - goal)
        length = np.linalg.norm(q[node] - q[neighbor])
        geometry = np.array([length, near, far, (near - far) / length])
        if net.workspace_points:
            slot = np.argmax(np.asarray(roadmap.neighbors[node]) == neighbor)
            geometry = np.append(geometry, encoding.through[node, slot])
        first = first + linear(net.decoder_near_data, np.append(q[node], goal))
        first = first + linear(net.decoder_far_data, np.append(q[neighbor], goal))
        first = first + linear(net.decoder_geometry, geometry)
    decoded = relu(linear(net.decoder_out, relu(first)))
    value = linear(net.value_out, relu(linear(net.value_hidden, decoded)))
    if net.geometric_features:
        value = value + linear(net.value_geometry, geometry)
    return value[0]
